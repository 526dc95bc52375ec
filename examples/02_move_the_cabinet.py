"""Move the cabinet by 1.2 m and see which links notice. Nothing is trained again."""

from pathlib import Path

import rfsg

lab = Path(__file__).parents[1] / "assets" / "scenes" / "lab.usda"
scene = rfsg.Scene.from_usd(lab)
before = rfsg.simulate(scene, frequency=2.44e9, quality="draft")
moved = scene.moved("/World/Cabinet", (1.2, 0.0, 0.0))
after = rfsg.simulate(moved, frequency=2.44e9, quality="draft")

for old, new in zip(before.links(), after.links(), strict=True):
    change = new["path_gain_db"] - old["path_gain_db"]
    paths = f"{old['n_paths']} -> {new['n_paths']} paths"
    print(f"{old['tx']} -> {old['rx']}: {change:+.2f} dB, {paths}")
