"""What a scene and a question need: the Quality that a user turns, and the Plan that follows."""

from dataclasses import dataclass, fields, replace

from rfsg.objects.shapes.band import WAYS as INTERSECTIONS  # what they are: ``tracer.intersect``
from rfsg.scene.world import World


@dataclass(frozen=True)
class Quality:
    """How hard to look. Every field may be overridden: ``Quality.named("draft", depth=2)``.

    Fields left alone are those of "standard", but for ``diffraction``, which a Quality made by hand
    asks for itself. What each costs and buys is from docs/tradeoff.md: one field at a time, errors
    of path gain at 90 % of links, on its street of 20 links where nothing else is said.

    depth: most reflections on a path. Cheap among planes: 5 for 3 costs 1.1 times the time and brings
        0.7 dB to 0.4; in tetam_lab, 47 boxes, 5 times and 6 dB.
    curved: most of them on curved or learned faces (each scatters a wave widely; two are weak). In the
        lab, five learned objects at 2.44 GHz, 0 takes 0.4 times the time of 1 and moves 0.17 dB; 2 takes
        2.5 times and moves 0.13 dB, for from 2 on the search is by rays where anything is curved.
    curved_depth: most reflections in all on a path that has a curved or learned face: in the lab 3 in
        place of 1 takes 4 times as long and moves 0.4 dB.
    diffraction: most edges that a path bends round: 0, 1 or 2. The dearest field: 1 costs 7 times
        the time of 0 and buys 3 dB (12 in tetam_lab); 2 another 37 times, and 0.6 dB.
    diffraction_depth: most interactions in all on a path that bends round one edge: 1 in place of 2
        takes a third of the time and costs 0.5 dB.
    diffuse: tiles per face and direction, at least, from which rough surfaces scatter (0: none).
    phase_seed: which draw of the tiles' random phases. refraction: solids bend what goes through them.
    search: "auto" enumerates all sequences of faces where the scene is small enough (nothing can be
        missed) and launches rays elsewhere; "enumerate" or "rays" insist.
    rays: directions launched from each transmitter at most, or from each receiver where these are
        fewer (Fibonacci lattice), by "rays" only. They go out in rounds, an eighth, an eighth, a quarter,
        a half; one that finds no new chain is the last. What each found, and how much more may be
        missing, stands in the report. 2,000 lose 2 of 936 paths, 20,000 none; time grows with them.
    floor_db: paths weaker than this below free space at the same length are not followed [dB]. -50
        keeps two thirds of the paths of -80, is hardly quicker, and within 0.2 dB. Sequences of faces are
        given up where the largest reflection of each, at the angles it may be met at, proves it.
    epsilon: search tolerance of a march on learned shapes [m] (the paper's 0.01 m); hits are polished.
        From 0.001 to 0.05 it moves nothing in the lab, by rays; the least is half as slow again.
    crossing_samples: nodes per stretch inside a learned object (transport integral, Eq. 23). From 4 to
        64 costs nothing to speak of and moves 0.001 dB in the lab.
    intersection: how rays meet learned shapes: "certain", or a faster way with a measured error,
        "newton", "mesh" or "grid" (``tracer.intersect``).
    integral: "telescoped" in occupancy, or "riemann", the paper's left sum: 0.001 dB apart in the lab.
    zone_rings: rings of sample points in a Fresnel zone where a learned surface is measured. In the lab
        1 is hardly quicker and moves a link by 3.6 dB; 4 in place of 2 moves 0.2 dB.
    refits: most rounds of zone measurement and Newton steps on a path with learned surfaces. In the lab
        4 find what 10 find.
    newton: most Newton steps per round.
    map_rays: directions from each transmitter for power estimates and radio maps.
    chunk: most rays or points at a time (bounds memory).
    """

    depth: int = 3
    curved: int = 1
    curved_depth: int = 2
    diffraction: int = 0
    diffraction_depth: int = 2
    diffuse: int = 0
    phase_seed: int = 0
    refraction: bool = True
    search: str = "auto"
    rays: int = 20_000
    floor_db: float = -80.0
    epsilon: float = 0.01
    crossing_samples: int = 16
    intersection: str = "certain"
    integral: str = "telescoped"
    zone_rings: int = 2
    refits: int = 16
    newton: int = 12
    map_rays: int = 100_000
    chunk: int = 65_536

    def __post_init__(self) -> None:
        if self.intersection not in INTERSECTIONS:
            raise ValueError(
                f"intersection={self.intersection!r}: expected one of {', '.join(INTERSECTIONS)}"
            )

    @staticmethod
    def named(name: str, **overrides: object) -> "Quality":
        if name not in PRESETS:
            raise ValueError(
                f"quality {name!r}: expected one of {', '.join(PRESETS)}; "
                "single fields are overridden by keyword, e.g. depth=2"
            )
        known = {f.name for f in fields(Quality)}
        wrong = sorted(set(overrides) - known)
        if wrong:
            raise ValueError(
                f"quality field {wrong[0]!r}: expected one of {', '.join(sorted(known))}"
            )
        return replace(PRESETS[name], **overrides)  # type: ignore[arg-type]


PRESETS = {
    "draft": Quality(
        depth=2,
        curved_depth=1,
        rays=5_000,
        floor_db=-60.0,
        crossing_samples=8,
        refits=10,
        map_rays=20_000,
    ),
    "standard": Quality(diffraction=1),
    "reference": Quality(
        depth=5,
        diffraction=2,
        curved=2,
        curved_depth=5,
        rays=200_000,
        floor_db=-200.0,
        crossing_samples=128,
        zone_rings=5,
        map_rays=1_000_000,
    ),
}


@dataclass(frozen=True)
class Plan:
    """What will be computed for this scene and this question, and what is left out, in sentences."""

    quality: Quality
    modelled: tuple[str, ...]
    left_out: tuple[str, ...]

    def with_(self, modelled: tuple[str, ...] = (), left_out: tuple[str, ...] = ()) -> "Plan":
        """The same plan with more to say."""
        return Plan(self.quality, (*self.modelled, *modelled), (*self.left_out, *left_out))


def make_plan(world: World, quality: Quality) -> Plan:
    """Look at the scene and say what it asks for."""
    scene = world.scene
    radios = (*scene.transmitters, *scene.receivers)
    modelled, left_out = ["line of sight and its blocking"], []
    if len(world) and quality.depth:
        modelled.append(
            f"specular reflection up to {quality.depth} times, with penetration between"
        )
    elif len(world):
        left_out.append("reflection: the depth asked for is 0")
    else:
        left_out.append("reflection and penetration: the scene holds no objects")
    if bool((~world.exact).any()):
        modelled.append("learned faces measured over the Fresnel zone before they steer a path")
    elif len(world):
        left_out.append("Fresnel-zone measurement of faces: every shape is known exactly")
    if any(r.polarization != "none" for r in radios):
        modelled.append("polarisation: complex field vectors along each path")
    else:
        left_out.append(
            "polarisation: no radio is polarised; links carry the mean power of TE and TM"
        )
    if any(bool(r.velocity.any()) for r in radios) or bool(world.velocity.any()):
        modelled.append("Doppler of moving radios and objects")
    else:
        left_out.append("Doppler: nothing moves")
    if not bool(world.solid.any()):
        left_out.append("refraction: the scene holds no solid")
    elif not quality.refraction:
        left_out.append("refraction: not asked for (refraction=False); solids are crossed straight")
    else:
        modelled.append("refraction in solids, at faces that are not parallel planes")
    if not quality.diffraction:
        left_out.append("edge diffraction: not asked for (diffraction=0)")
    bodies = {id(n.body): n.body for n in scene.nodes}.values()  # instances of one are asked once
    rough = any(body.scattering is not None for body in bodies)
    if not quality.diffuse:
        kept = "; mirrors do without the share all the same" * rough
        left_out.append(f"diffuse reflection: not asked for (diffuse=0){kept}")
    elif not (rough or bool(world.learned_surface.any())):
        left_out.append("diffuse reflection: no surface of the scene scatters")
    elif not quality.depth:
        left_out.append("diffuse reflection: the depth asked for is 0")
    left_out.append(f"paths more than {-quality.floor_db:g} dB below free space of their length")
    return Plan(quality, tuple(modelled), tuple(left_out))
