"""Train assets/objects from the meshes of make_meshes.py, and write their README.

``python assets/sources/train_all.py [NAME ...]`` trains the named objects (all, if none is named)
one after the other, a few minutes each on one core; an interrupted training is taken up where it
stopped. The figures in assets/objects/README.md come from the assets' own provenance.
"""

import sys
import tempfile
from pathlib import Path

from make_meshes import MAKERS
from rich.progress import Progress

from rfsg.assets import illustrate
from rfsg.learn.geometry import Report, learn_shape_file
from rfsg.objects.contract import Surface
from rfsg.objects.surfaces.interface import Conductor
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene.assets import load_asset
from rfsg.scene.library import Library

OBJECTS = Path(__file__).resolve().parents[1] / "objects"
PRIOR = "radio material is a prior, not fitted to measurements"

README = """# Trained objects

Neural shapes learned by `rfsg learn-shape` from the meshes of `assets/sources/make_meshes.py`; made
again by `python assets/sources/train_all.py`. Metres, z up, front towards +x, the origin in the
middle of the footprint. The cabinet is a perfect conductor. The radio materials of the others are
priors, not fitted to measurements.

Millimetres. *Surface*: |f| at points of the mesh. *Zero set*: from the learned surface to the mesh.
*Normal*: angle between the gradient and the mesh's normal, in degrees. *Slope*: mean ||grad f| - 1|
near the surface. Seconds are wall-clock time, on a machine that was shared.

Surface and zero set: mean / 95 % / max; normal: median / 95 %.

| object | surface | zero set | normal | volume % | slope | Lipschitz | steps | s |
|---|---|---|---|---|---|---|---|---|
"""


def surface_of(name: str) -> tuple[Surface, str]:
    """How an object answers a wave, and where that comes from."""
    if name == "cabinet":
        return Conductor(), "sheet steel taken as a perfect conductor"
    if name == "person":
        # About -4 dB off the skin, and no wave to speak of through the body.
        return StochasticSurface(m=2.0, alpha=0.7, sharpness=40.0, interaction_length=0.015), PRIOR
    # Boards of 3 to 4 cm: about -11 dB reflected, and 2 dB lost on the way through.
    return StochasticSurface(m=0.0, alpha=0.7, sharpness=10.0, interaction_length=0.3), PRIOR


def train(name: str, meshes: Path) -> None:
    """Make the mesh, learn it, save the asset."""
    source = meshes / f"{name}.ply"
    MAKERS[name]().export(source)
    surface, radio = surface_of(name)
    with Progress() as bar:
        task = bar.add_task(name, total=None)
        learn_shape_file(
            source,
            OBJECTS / name / f"{name}.usda",
            surface=surface,
            provenance={"source": f"assets/sources/make_meshes.py:{name}", "radio": radio},
            progress=lambda done, total, text: bar.update(
                task, completed=done, total=total, description=f"{name}: {text}"
            ),
            overwrite=True,
        )
    illustrate(OBJECTS / name / f"{name}.usda", overwrite=True)


def write_readme() -> None:
    rows = []
    for name in MAKERS:
        path = OBJECTS / name / f"{name}.usda"
        if path.exists():
            rows.append(_row(name, Report(**load_asset(path).provenance["report"])))
    (OBJECTS / "README.md").write_text(README + "".join(rows))
    Library(OBJECTS)  # writes its index


def _row(name: str, r: Report) -> str:
    cells = [
        name,
        f"{r.surface_mean_mm:.3f} / {r.surface_p95_mm:.2f} / {r.surface_max_mm:.2f}",
        f"{r.zero_mean_mm:.3f} / {r.zero_p95_mm:.2f} / {r.zero_max_mm:.2f}",
        f"{r.normal_median_deg:.2f} / {r.normal_p95_deg:.1f}",
        f"{r.volume_error_percent:+.2f}",
        f"{r.gradient_norm_error:.3f}",
        f"{r.lipschitz:.2f}",
        str(r.steps),
        f"{r.seconds:.0f}",
    ]
    return "| " + " | ".join(cells) + " |\n"


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        for chosen in sys.argv[1:] or MAKERS:
            train(chosen, Path(folder))
            write_readme()
