"""The program ``advnerf``. A stop imports only what it needs, and promises a first word before it imports anything."""

from __future__ import annotations

import sys

from nodes.cli.first_word import promise_first_word


def main() -> None:
    """Run the command line."""
    if sys.argv[1:2] == ["disarm"] and "--help" not in sys.argv:
        promise_first_word()
        raise SystemExit(_disarm(sys.argv[2:]))
    from nodes.cli.main import main as run

    run()


def _disarm(words: list[str]) -> int:
    """Parse the options of ``disarm``. The library of the other commands takes half a second to import."""
    import argparse
    from pathlib import Path

    from nodes.cli.stop import stop

    parser = argparse.ArgumentParser(prog="advnerf disarm", add_help=False)
    parser.add_argument("--run-dir", type=Path)
    parser.add_argument("--reason", default="")
    options = parser.parse_args(words)
    try:
        return stop(options.run_dir, options.reason)
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    main()
