"""Reproduce: ``python reproduce.py`` makes every table and figure of the paper; ``--help`` says
more.
"""

from ghpt.commands.catalogue import run_by_name

if __name__ == "__main__":
    run_by_name("reproduce")
