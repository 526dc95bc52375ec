"""What shows itself in a notebook."""

from importlib import import_module


class Displayed:
    """Shows itself in a notebook, where a last line that is an object becomes HTML.

    Tables and pictures are the roof's (``rfsg.notebook``), found by name when one is asked for: the
    floors below import nothing of it.
    """

    def _repr_html_(self) -> str:
        return import_module("rfsg.notebook").html(self)
