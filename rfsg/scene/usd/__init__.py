"""USD <-> Scene: the only door to pxr.

Attributes are the truth (``rfsg:neural:*``, ``rfsg:material:*``, ``rfsg:radio:*``, ``rfsg:shape``,
``rfsg:velocity``, ``rfsg:frequencyHz``); the API schemas of ``rfsg/scene/schema/`` are a
courtesy to other programs, and the fallbacks are the tables of ``rfsg.scene.fields``. All rfsg
values are SI, whatever metersPerUnit says: thickness in metres, velocity in m/s along the stage's
axes. The loader converts places and sizes to metres and turns the stage so that z is up.

Where USD leaves room: visibility does not make a thing vanish for waves (``active = false`` does);
purposes guide and proxy do; a material bound on an ancestor holds for all below it; the numbers of
a neural object are metres of the layer that brought its weights in.

``reading`` walks a stage and ``writing`` makes one; ``objects`` reads one asset, ``packaging`` writes
it, and ``validation`` says what is amiss with either. ``edits`` writes what was changed as a layer
over a scene's source, and ``live`` follows a stage that others edit. What each
kind of thing is in USD, read and written, is in ``shapes``, ``materials``, ``radios`` and
``placements``. Below them: ``attributes``, ``composition``, ``layers``, ``faults``.
"""

from rfsg.scene.usd.edits import save_edits, with_variant
from rfsg.scene.usd.live import LiveScene
from rfsg.scene.usd.objects import AssetRecord, read_asset
from rfsg.scene.usd.packaging import write_asset
from rfsg.scene.usd.reading import read
from rfsg.scene.usd.validation import check
from rfsg.scene.usd.writing import write

__all__ = [
    "AssetRecord",
    "LiveScene",
    "check",
    "read",
    "read_asset",
    "save_edits",
    "with_variant",
    "write",
    "write_asset",
]
