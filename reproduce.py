"""Reproduce: ``python reproduce.py`` makes every table and figure of the paper; ``--help`` says
more.
"""

import sys
from pathlib import Path

from ghpt.commands.app import run
from ghpt.commands.reproduce import command, spread

CONF = Path(__file__).parent / "conf"

if __name__ == "__main__":
    sys.argv = spread(sys.argv)
    run(CONF, command(CONF))
