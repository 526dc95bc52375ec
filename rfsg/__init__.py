"""rfsg: radio ray tracing with neural objects that are trained once and reused in any scene.

    import rfsg

    scene = rfsg.Scene.from_usd("lab.usda")
    result = rfsg.simulate(scene, frequency=2.44e9)
    moved = result.after(scene.moved("/World/Cabinet", (1.2, 0, 0)))

Conventions, everywhere:

- SI units: metres, hertz, seconds, radians, watts. dB and dBm only at the edges: command line,
  files, pictures, and fields whose names end in ``_db``, ``_dbm`` or ``_ns``.
- World frame: right-handed, z up. Azimuth is counted from +x towards +y, elevation from the
  horizon. A direction is a direction of travel.
- Shapes: f < 0 inside, normals point outward.
- Time exp(+j 2 pi f t): a path of delay tau carries exp(-j 2 pi f tau), and a permittivity is
  eps_r - j sigma / (2 pi f eps_0).
- h(f) = sum over paths of gain_l(f) exp(-j 2 pi f delay_l): the channel between the given
  antennas for 1 W in. Path gain is |h|^2.
- Positions, lengths, delays and phases are float64.
- Parameter values change in place, as torch's optimisers do; the structure of a scene never does:
  ``moved``, ``replaced``, ``without``, ``added`` and ``with_variant`` return a new scene that shares
  the objects.

Nothing heavy is imported until one of the names below is asked for.
"""

import gc
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rfsg.assets import export as export
    from rfsg.learn.fit import Fitted as Fitted
    from rfsg.learn.fit import fit as fit
    from rfsg.learn.measurements import Measurements as Measurements
    from rfsg.learn.predict import predict as predict
    from rfsg.objects.body import Body as Body
    from rfsg.scene.arrays import Array as Array
    from rfsg.scene.importers import import_scene as import_scene
    from rfsg.scene.library import Library as Library
    from rfsg.scene.patterns import Pattern as Pattern
    from rfsg.scene.pose import Pose as Pose
    from rfsg.scene.radios import Radio as Radio
    from rfsg.scene.scene import Node as Node
    from rfsg.scene.scene import Scene as Scene
    from rfsg.scene.scene import SceneError as SceneError
    from rfsg.scene.usd.live import LiveScene as LiveScene
    from rfsg.tracer.dial import simulate_within as simulate_within
    from rfsg.tracer.mimo import capacity as capacity
    from rfsg.tracer.mimo import mimo as mimo
    from rfsg.tracer.plan import Quality as Quality
    from rfsg.tracer.radiomap import radio_map as radio_map
    from rfsg.tracer.radiomap import radio_map_on as radio_map_on
    from rfsg.tracer.simulate import Result as Result
    from rfsg.tracer.simulate import simulate as simulate
    from rfsg.tracer.tradeoff import tradeoff as tradeoff

__version__ = "0.1.0"

_HOME = {
    "Array": "rfsg.scene.arrays",
    "Body": "rfsg.objects.body",
    "Fitted": "rfsg.learn.fit",
    "Library": "rfsg.scene.library",
    "LiveScene": "rfsg.scene.usd.live",
    "Measurements": "rfsg.learn.measurements",
    "Node": "rfsg.scene.scene",
    "Pattern": "rfsg.scene.patterns",
    "Pose": "rfsg.scene.pose",
    "Quality": "rfsg.tracer.plan",
    "Radio": "rfsg.scene.radios",
    "Result": "rfsg.tracer.simulate",
    "Scene": "rfsg.scene.scene",
    "SceneError": "rfsg.scene.scene",
    "capacity": "rfsg.tracer.mimo",
    "export": "rfsg.assets",
    "fit": "rfsg.learn.fit",
    "import_scene": "rfsg.scene.importers",
    "mimo": "rfsg.tracer.mimo",
    "predict": "rfsg.learn.predict",
    "radio_map": "rfsg.tracer.radiomap",
    "radio_map_on": "rfsg.tracer.radiomap",
    "simulate": "rfsg.tracer.simulate",
    "simulate_within": "rfsg.tracer.dial",
    "tradeoff": "rfsg.tracer.tradeoff",
}

__all__ = [
    "Array",
    "Body",
    "Fitted",
    "Library",
    "LiveScene",
    "Measurements",
    "Node",
    "Pattern",
    "Pose",
    "Quality",
    "Radio",
    "Result",
    "Scene",
    "SceneError",
    "capacity",
    "export",
    "fit",
    "import_scene",
    "mimo",
    "predict",
    "radio_map",
    "radio_map_on",
    "simulate",
    "simulate_within",
    "tradeoff",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'rfsg' has no attribute {name!r}")
    collecting = gc.isenabled()
    gc.disable()  # an import makes half a million objects and none to collect: a tenth of its time
    try:
        return getattr(import_module(_HOME[name]), name)
    finally:
        if collecting:
            gc.enable()


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
