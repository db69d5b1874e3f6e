"""Reproduce: ``python reproduce.py`` makes every table and figure of the paper; ``--help`` says more."""

import sys
from functools import partial
from pathlib import Path

from ghpt.app import run
from ghpt.reproduce import gather, reproduce, spread, summary

CONF = Path(__file__).parent / "conf"

if __name__ == "__main__":
    sys.argv = spread(sys.argv)
    run(CONF, "reproduce", partial(reproduce, conf=CONF), summary, partial(gather, conf=CONF))
