"""Ask several nodes in one process whether they accept their configuration: ``python -m nodes.launching.check_together``.

Standard input is a JSON list of ``[name, module, configuration file, folder]``; standard output a JSON object of errors by name. One
process imports what the nodes share once, so that a launch can ask before it starts them.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import runpy
import sys

from advnerf_core.documents import parse_json


def main() -> None:
    """Ask each node as ``python -m MODULE --check`` would."""
    # Libraries of C print to the output, such as a camera's when it is loaded.
    answers = os.dup(sys.stdout.fileno())
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    problems = {}
    for name, module, config, folder in parse_json(sys.stdin.read(), "standard input"):
        if (
            problem := _problem(name, module, ["--check", "--config", config, "--folder", folder])
        ) is not None:
            problems[name] = problem
    with open(answers, "w", encoding="utf-8") as answered:
        json.dump(problems, answered)


def _problem(name: str, module: str, arguments: list[str]) -> str | None:
    """What a node says against its configuration; None if it accepts it."""
    errors, words = io.StringIO(), sys.argv
    sys.argv = [module, *arguments, "--name", name]
    code: object = 0
    try:
        with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
            runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as asked:
        code = asked.code
    except Exception as error:  # such as a module that is not there
        code = errors.write(f"{name}: {type(error).__name__}: {error}")
    finally:
        sys.argv = words
    lines = errors.getvalue().strip().splitlines()
    return None if not code else lines[-1] if lines else f"{name}: ended with exit code {code}"


if __name__ == "__main__":
    main()
