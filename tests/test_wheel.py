"""The wheel, installed in a fresh environment: all is in it, and an asset exported here is the same there."""

import json
import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
OBJECT = "/World/Cabinet"
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check")
NEEDED = (
    "rfsg/py.typed",
    "rfsg/scene/schema/generatedSchema.usda",
    "rfsg/scene/schema/plugInfo.json",
)

# Run by both interpreters. The cabinet stands between two radios and in the way of a third.
CHANNEL = """
import json, sys
import rfsg
from rfsg.scene.radios import Radio

scene = rfsg.Scene(
    transmitters=(Radio.at("/tx", -2.0, 0.4, 1.0),),
    receivers=(Radio.at("/rx", 2.0, 1.5, 1.1), Radio.at("/behind", 2.0, -0.5, 0.9)),
    frequency=2.44e9,
).added(sys.argv[1], "/World/Cabinet", at=(0.0, 0.0, 0.0), yaw_deg=20.0)
h = rfsg.simulate(scene).transfer().reshape(-1)
print(json.dumps({"file": rfsg.__file__, "re": h.real.tolist(), "im": h.imag.tolist()}))
"""

pytestmark = pytest.mark.slow


def ran(*command: str | Path, cwd: Path) -> str:
    """What a command says; none of the checkout is on its path."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=clean, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    ran(*PIP, "wheel", "--no-deps", "-w", folder, REPOSITORY, cwd=folder)
    (file,) = folder.glob("rfsg-*.whl")
    return file


@pytest.fixture(scope="module")
def fresh(wheel, tmp_path_factory) -> Path:
    """The folder of a fresh environment's programs. rfsg is the wheel's; what it needs is borrowed."""
    root = tmp_path_factory.mktemp("fresh")
    venv.create(root)
    programs = root / ("Scripts" if os.name == "nt" else "bin")
    pip = (*PIP, "--python", programs / "python")
    ran(*pip, "install", "--no-deps", "--no-index", wheel, cwd=root)
    own = ran(
        programs / "python",
        "-c",
        "import sysconfig; print(sysconfig.get_path('purelib'))",
        cwd=root,
    )
    # a folder named in a .pth file is only added: the checkout's own .pth in it is not followed
    Path(own.strip(), "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return programs


def test_it_holds_the_package_and_nothing_else(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    tops = {name.split("/")[0] for name in names}
    assert {top.partition("-")[0] for top in tops} == {"rfsg"} and len(tops) == 2
    kept = [p for p in (REPOSITORY / "rfsg").rglob("*") if p.is_file() and p.suffix != ".pyc"]
    sources = {p.relative_to(REPOSITORY).as_posix() for p in kept}
    assert sources == {name for name in names if name.startswith("rfsg/")}
    assert names.issuperset(NEEDED)


def test_the_program_starts(fresh, tmp_path):
    assert "Usage" in ran(fresh / "rfsg", "--help", cwd=tmp_path)


@pytest.mark.parametrize("packed", [True, False], ids=["usdz", "folder"])
def test_an_asset_exported_here_gives_the_same_channel_there(fresh, tmp_path, packed):
    (tmp_path / "other").mkdir()
    asset = tmp_path / ("cabinet.usdz" if packed else "cabinet")
    scene = REPOSITORY / "assets" / "scenes" / "lab.usda"
    module = ("-c", "import sys; from rfsg.cli import main; sys.exit(main())")
    ran(sys.executable, *module, "export", scene, OBJECT, "-o", asset, cwd=REPOSITORY)
    file = asset if packed else next(asset.glob("*.usda"))

    here = json.loads(ran(sys.executable, "-c", CHANNEL, file, cwd=REPOSITORY))
    there = json.loads(ran(fresh / "python", "-c", CHANNEL, file, cwd=tmp_path / "other"))
    assert Path(here["file"]).is_relative_to(REPOSITORY / "rfsg")
    assert Path(there["file"]).is_relative_to(fresh.parent)
    for part in ("re", "im"):
        assert there[part] == pytest.approx(here[part], rel=1e-9, abs=0)
    assert any(abs(value) > 0 for value in here["re"])
