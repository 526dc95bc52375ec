"""Pieces of text USD for the tests of this folder."""


def cube(name: str = "Wall", ops: str = "", order: str = "", extra: str = "") -> str:
    """A Cube of size 2 bound to the concrete material."""
    return f"""
    def Cube "{name}" (
        prepend apiSchemas = ["MaterialBindingAPI"]
    )
    {{
        rel material:binding = </World/Concrete>
        {ops}
        uniform token[] xformOpOrder = [{order}]
        {extra}
    }}
"""


def known(kind: str, attributes: str, order: str = "") -> str:
    """A gprim /World/Thing of any kind, of metal."""
    return f"""
    def {kind} "Thing"
    {{
        custom token rfsg:material:model = "conductor"
        {attributes}
        uniform token[] xformOpOrder = [{order}]
    }}
"""
