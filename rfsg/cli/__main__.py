"""``python -m rfsg.cli``, the same as ``rfsg``."""

from rfsg.cli import main

main()
