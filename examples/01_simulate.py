"""From a USD scene to its channels, in ten lines."""

from pathlib import Path

import rfsg

lab = Path(__file__).parents[1] / "assets" / "scenes" / "lab.usda"
scene = rfsg.Scene.from_usd(lab)
result = rfsg.simulate(scene, frequency=2.44e9, quality="draft")
for link in result.links():
    print(f"{link['tx']} -> {link['rx']}: {link['rss_dbm']:.1f} dBm, {link['n_paths']} paths")
