"""``ghpt COMMAND key=value ...``, also as ``python -m ghpt``: the commands, by their names."""

import os
import sys
from collections.abc import Sequence
from importlib.util import find_spec

import __main__
import ghpt
from ghpt.commands.catalogue import SUMMARIES, run_by_name
from ghpt.commands.display import until_reader_leaves

_USAGE = "Usage: ghpt COMMAND [key=value ...]; ghpt COMMAND --help says more."
_COMPLETION = {"-sc", "--shell-completion"}


def main(words: Sequence[str] | None = None) -> None:
    """Run the command that the first word names with the words after it; by default of sys.argv.

    Without a command it prints the usage. A word that names none ends the program with status 1.
    """
    with until_reader_leaves():
        _main(list(sys.argv[1:] if words is None else words))


def _main(given: list[str]) -> None:
    first = given[0] if given else "--help"
    if first in {"-h", "--help"}:
        print(_help())
    elif first == "--version":
        print(f"ghpt {ghpt.__version__}")
    elif _COMPLETION & set(given):
        _complete([word for word in given if word not in SUMMARIES])
    elif first in SUMMARIES:
        _run(first, given[1:])
    else:
        sys.exit(f"error: there is no command {first!r}. Existing: {', '.join(SUMMARIES)}.")


def _help() -> str:
    width = max(map(len, SUMMARIES))
    lines = [f"  {name:<{width}}  {summary}" for name, summary in SUMMARIES.items()]
    title = str(ghpt.__doc__).partition("\n")[0]
    return "\n".join([title, "", _USAGE, "", *lines])


def _run(name: str, words: Sequence[str]) -> None:
    sys.argv = [f"ghpt {name}", *words]
    # Lightning starts the other processes of a training with what this says: python -m ...
    __main__.__spec__ = find_spec(f"ghpt.commands.{name}")
    run_by_name(name)


def _complete(options: Sequence[str]) -> None:
    """Complete a command's name here, and let Hydra complete its settings."""
    program, *typed = os.environ.get("COMP_LINE", "ghpt").split(" ")
    name = typed[0] if typed else ""
    if name in SUMMARIES:
        os.environ["COMP_LINE"] = " ".join([program, *typed[1:]])
    elif any(option.startswith("query=") for option in options):
        print(" ".join(SUMMARIES))
        return
    sys.argv = ["ghpt", *options]
    run_by_name(name if name in SUMMARIES else "train")


if __name__ == "__main__":
    main()
