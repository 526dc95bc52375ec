"""The live page of ``rfsg view``: ``session`` is what is looked at, ``solver`` answers beside it, ``page``
shows it in a browser (the only door to viser), ``still`` is a page of one file that nothing serves."""
