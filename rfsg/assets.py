"""Assets with their pictures: objects exported, pictures added, and a library as one page of HTML.

What needs no picture is below: ``rfsg.scene.export``, ``rfsg.scene.assets``, ``rfsg.scene.library``.
"""

import base64
import html
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rfsg.scene.library import Card, Library
    from rfsg.scene.scene import Scene

PNG = b"\x89PNG\r\n\x1a\n"


def export(
    scene: "Scene",
    path: str,
    out: str | Path,
    *,
    provenance: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> Path:
    """Write the object at a prim path as an asset, with its picture; returns the USD file.

    out: a folder, NAME.usda, or a package NAME.usdz. Options and errors are those of
    ``rfsg.scene.export.export``.
    """
    from rfsg.plot_thumbnail import thumbnail
    from rfsg.scene.export import color_of, surface_of, usd_file
    from rfsg.scene.export import export as write
    from rfsg.scene.weights import refuse_overwrite

    node = scene.node(path)
    refuse_overwrite([usd_file(out)], overwrite)  # before the work
    mesh = surface_of(node)
    return write(
        scene,
        path,
        out,
        picture=thumbnail(*mesh, color=color_of(node.body)),
        mesh=mesh,
        provenance=provenance,
        overwrite=overwrite,
    )


def illustrate(asset: str | Path, *, overwrite: bool = False) -> Path:
    """Draw the picture of an asset (.usda) that has none, and write it and the hull into its layer.

    Raises SceneError for an asset that is not in order, and where a file NAME.png is there that the
    layer does not name, unless ``overwrite``."""
    from rfsg.objects.shapes.shown import hull_of, shown_mesh
    from rfsg.plot_thumbnail import thumbnail
    from rfsg.scene.assets import load_asset
    from rfsg.scene.export import color_of
    from rfsg.scene.usd.packaging import add_shown
    from rfsg.scene.weights import refuse_overwrite

    loaded = load_asset(asset)
    if loaded.picture is None:
        refuse_overwrite([loaded.path.with_suffix(".png")], overwrite)
        mesh = shown_mesh(loaded.body.shape)
        picture = thumbnail(*mesh, color=color_of(loaded.body))
        add_shown(loaded.path, picture, hull_of(mesh[0]))
    return loaded.path


def rows(library: "Library") -> list[dict[str, str]]:
    """A line for each asset of a library, in words."""
    return [
        {
            "name": card.name,
            "kind": f"{card.shape}, {card.surface}",
            "size [m]": " x ".join(f"{side:.3g}" for side in card.size),
            "band": band_text(card),
            "error": card.error or "not told",
            "MB": f"{card.bytes / 1e6:.2f}",
            "sha256": card.sha256[:12],
            "picture": str(library.folder / card.picture) if card.picture else "none",
        }
        for card in library.cards
    ]


def band_text(card: "Card") -> str:
    """The band of an asset in words; a known material holds at any frequency that its formula does."""
    if card.band is None:
        return "not told" if card.surface == "stochastic" else "any"
    low, high = (f"{hz / 1e9:g}" for hz in card.band)
    return f"{low} GHz" if low == high else f"{low} to {high} GHz"


def contact_sheet(library: "Library") -> str:
    """The library as one page of HTML that needs no other file: a picture and a few lines for each."""
    cards = "\n".join(_figure(library, card) for card in library.cards)
    title = html.escape(f"{library.folder.name}: {len(library)} assets")
    return PAGE.format(title=title, cards=cards)


def _figure(library: "Library", card: "Card") -> str:
    data = library.picture(card.name) or b""
    picture = '<div class="none">no picture</div>'
    if data.startswith(PNG):
        coded = base64.b64encode(data).decode()
        alt = html.escape(card.name, quote=True)
        picture = f'<img alt="{alt}" src="data:image/png;base64,{coded}">'
    size = " × ".join(f"{side:.3g}" for side in card.size)
    lines = [
        f"{card.shape} shape, {card.surface} surface",
        f"{size} m, {card.bytes / 1e6:.2f} MB",
        f"band: {band_text(card)}",
        card.error or "error: not told",
    ]
    told = "<br>".join(html.escape(line) for line in lines)
    name, file = html.escape(card.name), html.escape(card.file)
    return (
        f"<figure>{picture}<figcaption><b>{name}</b><p>{told}</p>"
        f"<code>{file}</code><code>{html.escape(card.sha256[:16])}</code></figcaption></figure>"
    )


PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{title}</title>
<meta name="viewport" content="width=device-width">
<style>
body {{ font: 15px/1.45 system-ui, sans-serif; margin: 2rem; color: #1d2733; background: #f4f6f8 }}
h1 {{ font-size: 1.25rem; font-weight: 600 }}
main {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(240px, 1fr)); gap: 1.25rem }}
figure {{ margin: 0; background: #fff; border-radius: 10px; overflow: hidden;
  box-shadow: 0 1px 4px #0002 }}
img, .none {{ display: block; width: 100%; aspect-ratio: 1 }}
.none {{ display: grid; place-items: center; color: #98a2ad }}
figcaption {{ padding: .75rem 1rem 1rem }}
p {{ margin: .35rem 0 .5rem; color: #4a5663 }}
code {{ display: block; font-size: .78rem; color: #7a8591; overflow-wrap: anywhere }}
</style>
<h1>{title}</h1>
<main>
{cards}
</main>
</html>
"""
