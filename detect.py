"""From videos to key points: ``python detect.py videos=videos/ output=pose/``; ``--help`` says
more.
"""

from ghpt.commands.catalogue import run_by_name

if __name__ == "__main__":
    run_by_name("detect")
