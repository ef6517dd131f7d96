"""The program ``advnerf``. A stop imports only what it needs, and promises a first word before it imports anything."""

from __future__ import annotations

import sys
from typing import NoReturn

from nodes.cli.first_word import promise_first_word


def main() -> None:
    """Run the command line."""
    words = (
        sys.argv[2:] if sys.argv[1:2] == ["car"] else sys.argv[1:]
    )  # both are a stop: advnerf disarm, advnerf car disarm
    if words[:1] == ["disarm"] and "--help" not in words:
        promise_first_word()
        raise SystemExit(_disarm(words[1:]))
    from nodes.cli.main import main as run

    run()


def _disarm(words: list[str]) -> int:
    """Parse the options of ``disarm``. The library of the other commands takes half a second to import."""
    import argparse
    from pathlib import Path

    from nodes.cli.stop import stop

    class Parser(argparse.ArgumentParser):
        def error(self, message: str) -> NoReturn:
            """Say what every failed stop says."""
            print(
                f"error: NOT CONFIRMED: {message}; expected advnerf disarm [--folder FOLDER] [--reason TEXT]."
                " The car may be driving. Use the e-stop",
                file=sys.stderr,
            )
            raise SystemExit(2)

    parser = Parser(prog="advnerf disarm", add_help=False)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--reason", default="")
    options = parser.parse_args(words)
    try:
        return stop(options.folder, options.reason)
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    main()
