"""``python -m nodes.cli``: the command without its installed script."""

from nodes.cli.program import main

if __name__ == "__main__":
    main()
