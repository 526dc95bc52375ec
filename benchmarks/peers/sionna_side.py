"""The peer's half: Sionna RT traces the cases and writes what it finds.

    .venv/bin/python sionna_side.py --out DIR CASE ...

Runs in benchmarks/peers/.venv and imports nothing of rfsg. Radios are isotropic and
polarised; the path solver runs with its defaults (1e6 samples) but for what a case sets. Receivers
are traced a few at a time: with hundreds in one call it silently runs out of room for candidates.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import mitsuba as mi

mi.set_variant("llvm_ad_mono_polarized")

import cases  # noqa: E402
import numpy as np  # noqa: E402
import sionna.rt as rt  # noqa: E402
from exchange import DIFFRACT, REFLECT, SCATTER, Traced, file_of  # noqa: E402
from sionna.rt.constants import InteractionType  # noqa: E402

RECEIVERS_AT_ONCE = 25
DIFFUSE_SAMPLES = 300_000  # each that hits the wall is a path
KINDS = {
    InteractionType.SPECULAR: REFLECT,
    InteractionType.DIFFRACTION: DIFFRACT,
    InteractionType.DIFFUSE: SCATTER,
}


def mesh(name: str, corners: np.ndarray) -> mi.Mesh:
    """A mesh of triangles [t 3 3]; corners that fall together are one vertex."""
    vertices, number = np.unique(corners.reshape(-1, 3).round(9), axis=0, return_inverse=True)
    triangles = number.reshape(-1, 3)
    properties = mi.Properties()
    properties["face_normals"] = True
    made = mi.Mesh(name, len(vertices), len(triangles), props=properties)
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = np.ravel(vertices).astype(np.float32)
    parameters["faces"] = np.ravel(triangles).astype(np.uint32)
    parameters.update()
    return made


def halves(faces: list[np.ndarray]) -> np.ndarray:
    """[2 n 3 3]: two triangles for each rectangle [corner, u, v]."""
    corners = [((c, c + u, c + u + v), (c, c + u + v, c + v)) for c, u, v in faces]
    return np.array(corners).reshape(-1, 3, 3)


def material(name: str, itu: str, thickness: float, rough: float) -> rt.RadioMaterial:
    common = {"thickness": thickness, "scattering_coefficient": rough, "color": (0.5, 0.5, 0.5)}
    if itu == "conductor":
        return rt.RadioMaterial(name, conductivity=1e10, **common)
    return rt.ITURadioMaterial(name, itu, **common)


def build(case: cases.Case) -> rt.Scene:
    scene = rt.load_scene()
    scene.frequency = case.frequency
    objects, materials = [], {}
    for thing in case.things:
        round_one = isinstance(thing, cases.Ball)
        drawn = thing.triangles() if round_one else halves(thing.faces())
        rough = thing.scattering if isinstance(thing, cases.Wall) else 0.0
        kind = (thing.itu, round(thing.thickness, 9), rough)
        if kind not in materials:
            name = f"{thing.itu}-{len(materials)}"
            materials[kind] = material(name, *kind)
        objects.append(
            rt.SceneObject(
                mi_mesh=mesh(thing.name, drawn), name=thing.name, radio_material=materials[kind]
            )
        )
    scene.edit(add=objects)
    if case.move is not None:
        name, by = case.move
        scene.objects[name].position += mi.Point3f(*by)
    ends = case.polarization, case.receiver_polarization or case.polarization
    scene.tx_array, scene.rx_array = (
        rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization=p) for p in ends
    )
    scene.add(rt.Transmitter("tx", position=mi.Point3f(*case.transmitter)))
    for r, place in enumerate(case.receivers):
        scene.add(rt.Receiver(f"rx{r}", position=mi.Point3f(*place)))
    return scene


def trace(case: cases.Case) -> Traced:
    parts = []
    at_once = 1 if case.diffuse else RECEIVERS_AT_ONCE
    for first in range(0, len(case.receivers), at_once):
        some = case.receivers[first : first + at_once]
        part = _trace(replace(case, receivers=some))
        parts.append(replace(part, rx=part.rx + first))
    return Traced.joined(parts)


def _trace(case: cases.Case) -> Traced:
    scene = build(case)
    paths = rt.PathSolver()(
        scene,
        max_depth=case.depth,
        samples_per_src=DIFFUSE_SAMPLES if case.diffuse else 1_000_000,
        diffuse_reflection=case.diffuse,
        refraction=case.refraction,
        diffraction=case.diffraction,
    )
    rx, column = np.nonzero(paths.valid.numpy()[:, 0])  # [r t p], one transmitter
    real, imaginary = (x.numpy()[rx, 0, 0, 0, column] for x in paths.a)
    theta_t, phi_t, theta_r, phi_r = (
        x.numpy()[rx, 0, column].astype(float)
        for x in (paths.theta_t, paths.phi_t, paths.theta_r, paths.phi_r)
    )
    seen = paths.interactions.numpy()[:, rx, 0, column].T  # [p d]
    number = {scene.objects[t.name].object_id: i for i, t in enumerate(case.things)}
    touched = paths.objects.numpy()[:, rx, 0, column].T
    kind = np.vectorize(lambda k: KINDS.get(int(k), -1), otypes=[int])(seen)
    item = np.vectorize(lambda k: number.get(int(k), -1), otypes=[int])(touched)
    vertex = paths.vertices.numpy()[:, rx, 0, column].transpose(1, 0, 2).astype(float)
    return Traced(
        names=np.array([t.name for t in case.things]),
        rx=rx,
        kind=kind,
        item=np.where(kind >= 0, item, -1),
        vertex=np.where((kind >= 0)[..., None], vertex, np.nan),
        crossed=(seen == InteractionType.REFRACTION).sum(1),
        delay=paths.tau.numpy()[rx, 0, column].astype(float),
        gain=real.astype(float) + 1j * imaginary.astype(float),
        departure=_unit(theta_t, phi_t),
        arrival=_unit(theta_r, phi_r),
    )


def _unit(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    s = np.sin(theta)
    return np.stack([s * np.cos(phi), s * np.sin(phi), np.cos(theta)], -1)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("cases", nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    for name in options.cases:
        trace(cases.named(name)).save(file_of(options.out, name, "sionna"))


if __name__ == "__main__":
    main()
