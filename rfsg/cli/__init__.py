"""The command line: thin commands over the same functions that Python users call.

``app`` puts the commands together and runs them; each command, or small family of them, is a file
of functions that know nothing of the others. What they share: ``options`` and ``parse`` (what
people write), ``scenes`` (reading and editing), ``terminal`` (what is printed) and ``errors``.

Heavy imports live inside the commands, so that ``rfsg --help`` answers at once. Exit codes: 0 done,
1 a fault of rfsg itself, 2 the command was not understood, 3 a scene, asset or file is at fault,
4 the numbers gave out (singular, out of memory), 130 interrupted.
"""

from rfsg.cli.app import main as main
from rfsg.cli.app import run as run
