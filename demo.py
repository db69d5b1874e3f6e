"""A demonstration without any file: ``python demo.py output=demo/``; ``--help`` says more."""

from ghpt.commands.catalogue import run_by_name

if __name__ == "__main__":
    run_by_name("demo")
