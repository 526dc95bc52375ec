"""Small scenes of other programs, written where a test wants them."""

import struct
from pathlib import Path

import numpy as np

WALL = np.array([[0.0, -1, 0], [0, 1, 0], [0, 1, 2], [0, -1, 2]])
QUAD = np.array([[0, 1, 2], [0, 2, 3]])


def write_ply(path: Path, points=WALL, faces=QUAD, kind: str = "binary_little_endian") -> Path:
    """A PLY file with a colour at every corner, which nobody asked for."""
    path.parent.mkdir(parents=True, exist_ok=True)
    head = (
        f"ply\nformat {kind} 1.0\ncomment made by a test\nelement vertex {len(points)}\n"
        "property float x\nproperty float y\nproperty float z\nproperty uchar red\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(kind)
    if order is None:
        rows = [" ".join(map(str, [*p, 7])) for p in np.asarray(points).tolist()]
        rows += [" ".join(map(str, [len(f), *f])) for f in faces]
        path.write_text(head + "\n".join(rows) + "\n")
        return path
    body = b"".join(struct.pack(f"{order}fffB", *p, 7) for p in np.asarray(points).tolist())
    body += b"".join(struct.pack(f"{order}B{len(f)}i", len(f), *f) for f in faces)
    path.write_bytes(head.encode() + body)
    return path


SHAPES = """
    <shape type="ply" id="mesh-wall">
        <string name="filename" value="meshes/wall.ply"/>
        <ref id="mat-itu_brick" name="bsdf"/>
    </shape>"""
MATERIALS = """
    <bsdf type="diffuse" id="mat-itu_brick"/>
    <bsdf type="itu-radio-material" id="pane">
        <string name="type" value="glass"/>
        <float name="thickness" value="$pane"/>
    </bsdf>
    <bsdf type="itu-radio-material" id="sheet metal">
        <string name="type" value="metal"/>
    </bsdf>
    <bsdf type="radio-material" id="own">
        <float name="relative_permittivity" value="3.5"/>
        <float name="conductivity" value="0.02"/>
        <float name="thickness" value="0.3"/>
        <float name="scattering_coefficient" value="0.25"/>
        <float name="xpd_coefficient" value="0.1"/>
    </bsdf>"""


def write_mitsuba(folder: Path, shapes: str = SHAPES, materials: str = MATERIALS) -> Path:
    """A scene with a brick wall across x = 0, |y| <= 1, 0 <= z <= 2, or other shapes."""
    write_ply(folder / "meshes" / "wall.ply")
    path = folder / "scene.xml"
    path.write_text(
        f'<scene version="2.1.0">\n    <default name="pane" value="0.012"/>\n'
        f"    <integrator type='path'/>{materials}{shapes}\n</scene>\n"
    )
    return path


def drawn(kind: str, material: str = "pane", extra: str = "", name: str = "thing") -> str:
    return f"""
    <shape type="{kind}" id="{name}">
        {extra}
        <ref id="{material}" name="bsdf"/>
    </shape>"""
