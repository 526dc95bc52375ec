"""Readers fed with spoiled files, in a process of its own: ``python -m tests.scene.fuzzing FOLDER``.

It takes seeds on standard input, one a line, and says of each what came of it. A seed names a kind of
file and the damage. A crash ends the process; so do 10 s of processor time and a minute of waiting.
"""

import hashlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import warnings
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from random import Random
from typing import Any

from tests.scene import damage

MARK = "CANARY-WAS-READ"
CANARY = f"#usda 1.0\n{MARK}\n".encode()
HANG, WAIT = 10, 60  # [s] of processor time, and of waiting
MEMORY = 4 * 2**30
REPOSITORY = Path(__file__).parents[2]
ENDINGS = (".usda", ".usdc", ".usdz", ".safetensors", ".csv", ".ply", ".png", ".bin")


def outcomes(seeds: Sequence[int], folder: Path) -> Iterator[dict[str, Any]]:
    """What came of each seed: {"seed", "kind", "outcome", "opened"}; outcome is "read", "refused", or
    what should not be. A seed below zero damages nothing."""
    todo = list(seeds)
    while todo:
        environment = os.environ | {"OMP_NUM_THREADS": "1", "PXR_WORK_THREAD_LIMIT": "1"}
        worker = subprocess.Popen(
            [sys.executable, "-m", "tests.scene.fuzzing", str(folder)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=REPOSITORY, env=environment, text=True,
        )  # fmt: skip
        assert worker.stdin is not None and worker.stdout is not None
        worker.stdin.write("".join(f"{seed}\n" for seed in todo))
        worker.stdin.close()
        for line in worker.stdout:
            told = json.loads(line)
            assert told["seed"] == todo.pop(0)
            yield told
        status = worker.wait()
        if todo:  # it died of this one
            how = signal.Signals(-status).name if status < 0 else str(status)
            yield {"seed": todo.pop(0), "kind": "?", "outcome": f"ended by {how}", "opened": []}


class Corpus:
    """Files in order, below FOLDER/in, which readers may read; canaries beside it."""

    def __init__(self, folder: Path):
        self.root, self.home = folder, folder / "in"
        self.home.mkdir(parents=True, exist_ok=True)
        for ending in ENDINGS:
            (self.root / f"canary{ending}").write_bytes(CANARY)
            link = self.home / f"link{ending}"
            if not link.is_symlink():
                link.symlink_to(self.root / f"canary{ending}")
        if not (self.home / "scenes").exists():
            for name in ("objects", "scenes"):
                shutil.copytree(REPOSITORY / "assets" / name, self.home / name)
            (self.home / "rfsg-assets.toml").touch()
        self.kinds = self._kinds()
        self.spoils = True  # not, to see that the files are in order

    def _kinds(self) -> dict[str, Callable[[Path, Random], Callable[[], Any]]]:
        """Each kind: of a folder for the case and a generator, what is to be done then."""
        return {
            "scene.usda": self.scene,
            "scene.usdc": self.crate,
            "asset.usda": self.asset,
            "asset.safetensors": self.weights,
            "asset.usdz": self.package,
            "library": self.library,
            "baked": self.baked,
            "pattern": self.pattern,
            "places.csv": self.places,
            "measurements.csv": self.measurements,
            "mitsuba.xml": self.mitsuba,
            "mesh": self.mesh,
            "plan.json": self.plan,
            "table.toml": self.table,
            "message": self.message,
        }

    def _spoiled(self, data: bytes, draw: Random, ways: Sequence[damage.Damage]) -> bytes:
        return draw.choice(ways)(data, draw) if self.spoils else data

    def _usda(self) -> tuple[damage.Damage, ...]:
        named = damage.paths(damage.ASSET, str(self.root), ".usda")
        weights = damage.paths(damage.ASSET, str(self.root), ".safetensors")
        return (*damage.BYTES, *damage.TEXT, *damage.TEXT, damage.other_targets, named, weights)

    # scenes and assets

    def scene(self, case: Path, draw: Random) -> Callable[[], Any]:
        from rfsg.scene import usd

        source = draw.choice(sorted((self.home / "scenes").glob("[a-z]*_lab.usda")) + [
            self.home / "scenes" / f"{n}.usda" for n in ("lab", "room", "street", "materials")])  # fmt: skip
        path = self.home / "scenes" / f"{case.name}.usda"
        path.write_bytes(self._spoiled(source.read_bytes(), draw, self._usda()))
        look = draw.choice([usd.read, usd.read, usd.check])
        return lambda: self._then_gone(look, path)

    def crate(self, case: Path, draw: Random) -> Callable[[], Any]:
        from pxr import Sdf

        from rfsg.scene import usd

        whole = self.home / "scenes" / "whole.usdc"
        if not whole.exists():
            Sdf.Layer.FindOrOpen(str(self.home / "scenes" / "lab.usda")).Export(str(whole))
        path = self.home / "scenes" / f"{case.name}.usdc"
        path.write_bytes(self._spoiled(whole.read_bytes(), draw, damage.BYTES))
        return lambda: self._then_gone(usd.read, path)

    def _then_gone(self, look: Callable[[Path], Any], path: Path) -> Any:
        try:
            return look(path)
        finally:
            path.unlink()

    def _copied(self, case: Path, name: str = "cabinet") -> Path:
        shutil.copytree(self.home / "objects" / name, case, dirs_exist_ok=True)
        return case / f"{name}.usda"

    def asset(self, case: Path, draw: Random) -> Callable[[], Any]:
        from rfsg.scene import usd
        from rfsg.scene.assets import load_asset

        path = self._copied(case)
        path.write_bytes(self._spoiled(path.read_bytes(), draw, self._usda()))
        return lambda: draw.choice([load_asset, usd.check])(path)

    def weights(self, case: Path, draw: Random) -> Callable[[], Any]:
        from rfsg.scene.assets import load_asset

        path = self._copied(case, draw.choice(["cabinet", "chair"]))
        weights = path.with_suffix(".safetensors")
        ways = (*damage.BYTES, *[damage.other_header] * 6, damage.other_tensors)
        data = self._spoiled(weights.read_bytes(), draw, ways)
        was = hashlib.sha256(weights.read_bytes()).hexdigest()
        weights.write_bytes(data)  # and its hash, so that the reader goes on
        text = path.read_text().replace(was, hashlib.sha256(data).hexdigest())
        path.write_text(text)
        return lambda: load_asset(path)

    def package(self, case: Path, draw: Random) -> Callable[[], Any]:
        from rfsg.scene.assets import load_asset
        from rfsg.scene.usd.packaging import write_package

        parts = {f"cabinet{e}": (self.home / "objects" / "cabinet" / f"cabinet{e}").read_bytes()
                 for e in (".safetensors", ".png", ".usda")}  # fmt: skip
        path = case / "cabinet.usdz"
        how = draw.randrange(3) if self.spoils else 0
        if how == 0:  # as a whole
            write_package(path, parts, False)
            path.write_bytes(self._spoiled(path.read_bytes(), draw, damage.BYTES))
        elif how == 1:  # one of its files
            name = draw.choice(list(parts))
            ways = self._usda() if name.endswith("usda") else damage.BYTES
            write_package(path, parts | {name: self._spoiled(parts[name], draw, ways)}, False)
        else:  # its names, its compression, its sizes
            with zipfile.ZipFile(path, "w") as package, warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of names that stand twice
                for name, data in reversed(parts.items()):
                    if draw.random() < 0.5:
                        name = damage.hostile_path(draw, str(self.root), Path(name).suffix) or name
                    package.writestr(name[:200], data, draw.choice([0, 0, 8]))
            if draw.random() < 0.5:
                self._lie(path, draw)
        return lambda: load_asset(path)

    @staticmethod
    def _lie(path: Path, draw: Random) -> None:
        """A size in the directory of a package that is not so."""
        data = bytearray(path.read_bytes())
        at = data.find(b"PK\x01\x02") + draw.choice([20, 24, 42])
        data[at : at + 4] = draw.choice([2**32 - 1, 2**31, 0, 1]).to_bytes(4, "little")
        path.write_bytes(data)

    def library(self, case: Path, draw: Random) -> Callable[[], Any]:
        from rfsg.scene.library import Library

        self._copied(case / "cabinet")
        index = case / "index.json"
        told = (self.home / "objects" / "index.json").read_bytes()
        named = damage.paths(damage.QUOTED, str(self.root), ".png")
        ways = (*damage.BYTES, *[damage.other_nodes] * 4, damage.other_numbers, named)
        index.write_bytes(self._spoiled(told, draw, ways))

        def look() -> None:
            library = Library(case)
            for name in library:
                library.picture(name)

        return look

    def baked(self, case: Path, draw: Random) -> Callable[[], Any]:
        from rfsg.objects.shapes import kept
        from tests.objects.shapes.test_baked import STEP, small

        whole = self.home / "baked"
        if not whole.exists():
            whole.mkdir()
            kept.baked(small(), whole, STEP)
        (file,) = whole.iterdir()
        ways = (*damage.BYTES, *[damage.other_header] * 6, damage.other_tensors)
        path, data = case / file.name, file.read_bytes()
        path.write_bytes(self._spoiled(data, draw, ways))
        key = kept._head(data)["key"]
        return lambda: kept._read(path, key)

    # tables

    def pattern(self, case: Path, draw: Random) -> Callable[[], Any]:
        import numpy as np
        import torch

        from rfsg.scene.patterns import Pattern

        if draw.random() < 0.5:
            rows = [f"{a} {a / 36:.2f}" for a in range(360)]
            text = "\n".join(
                ["NAME x", "GAIN 12 dBd", "HORIZONTAL 360", *rows, "VERTICAL 360", *rows]
            )
            path, data = case / "p.msi", text.encode()
        else:
            grid = np.linspace(0, 180, 19), np.linspace(0, 350, 36)
            made = Pattern.from_samples("x", *grid, torch.ones(19, 36, dtype=torch.float64))
            path, data = case / "p.csv", made.csv()
        path.write_bytes(self._spoiled(data, draw, (*damage.BYTES, *damage.TEXT)))
        return lambda: Pattern.from_file(path)

    def places(self, case: Path, draw: Random) -> Callable[[], Any]:
        from rfsg.scene.arrays import Array
        from rfsg.scene.receivers import from_csv

        many = "".join(f"r{i},{i},2,1.5\n" for i in range(20))
        few = "".join(f"{i},0.5,0\n" for i in range(8))
        text, look = draw.choice(
            [("name,x,y,z\n" + many, from_csv), ("x,y,z\n" + few, Array.from_csv)]
        )
        path = case / "places.csv"
        path.write_bytes(self._spoiled(text.encode(), draw, (*damage.BYTES, *damage.TEXT)))
        return lambda: look(path)

    def measurements(self, case: Path, draw: Random) -> Callable[[], Any]:
        from rfsg.learn.measurements import Measurements

        head = "tx,rx_x_m,rx_y_m,rx_z_m,frequency_hz,rssi_dbm,gain_re,gain_im,threshold_dbm\n"
        rows = [f"/World/AP,{i},2,1.5,2.4e9,{-40 - i},,,-100\n" for i in range(10)]
        rows += [f"/World/AP,{i},3,1.5,2.4e9,,1e-4,{i}e-5,\n" for i in range(10)]
        path = case / "measured.csv"
        text = (head + "".join(rows)).encode()
        path.write_bytes(self._spoiled(text, draw, (*damage.BYTES, *damage.TEXT)))
        return lambda: Measurements.from_csv(path)

    # importers

    def _import(self, path: Path, table: Path | None = None) -> Callable[[], Any]:
        from rfsg.scene.importers.api import imported_file

        return lambda: imported_file(path, table, None, None)

    def mitsuba(self, case: Path, draw: Random) -> Callable[[], Any]:
        from tests.scene import importing

        kinds = ("sphere", "cube", "rectangle", "disk")
        shapes = importing.SHAPES + "".join(importing.drawn(k, name=k) for k in kinds)
        path = importing.write_mitsuba(case, shapes)
        named = damage.paths(damage.QUOTED, str(self.root), ".ply")
        path.write_bytes(
            self._spoiled(path.read_bytes(), draw, (*damage.BYTES, *damage.TEXT, named))
        )
        return self._import(path)

    def mesh(self, case: Path, draw: Random) -> Callable[[], Any]:
        import trimesh

        from tests.scene.importing import write_ply

        ending = draw.choice(["obj", "ply", "ply", "glb", "gltf", "stl"])
        path = case / f"thing.{ending}"
        if ending == "ply":
            write_ply(
                path, kind=draw.choice(["ascii", "binary_little_endian", "binary_big_endian"])
            )
        elif ending == "gltf":
            for name, data in trimesh.exchange.gltf.export_gltf(
                trimesh.Scene(trimesh.creation.box())
            ).items():
                (case / name).write_bytes(data)
            (case / "model.gltf").rename(path)
        else:
            trimesh.Scene(trimesh.creation.box()).export(path)
        ways: tuple[damage.Damage, ...] = damage.BYTES
        if ending == "gltf":
            named = damage.paths(damage.QUOTED, str(self.root), ".bin")
            ways += (damage.other_nodes, damage.other_nodes, damage.other_numbers, named)
        elif ending in ("obj", "ply"):
            ways += (damage.other_numbers, damage.other_words, damage.lines)
        path.write_bytes(self._spoiled(path.read_bytes(), draw, ways))
        return self._import(path, self._table(case))

    def plan(self, case: Path, draw: Random) -> Callable[[], Any]:
        door = {"at": 2.0, "width": 0.9, "height": 2.1}
        walls = [{"name": f"w{i}", "line": [[0, i], [4, i], [4, i + 1]], "material": "brick",
                  "openings": [door]} for i in range(4)]  # fmt: skip
        room = {"name": "r", "kind": "floor", "material": "brick",
                "polygon": [[0, 0], [4, 0], [4, 4], [0, 4]]}  # fmt: skip
        told = {"materials": {"brick": {"itu": "brick"}}, "defaults": {"height": 3}}
        path = case / "plan.json"
        data = json.dumps(told | {"features": [*walls, room]}).encode()
        ways = (*damage.BYTES, *[damage.other_nodes] * 6, *damage.TEXT)
        path.write_bytes(self._spoiled(data, draw, ways))
        return self._import(path)

    def table(self, case: Path, draw: Random) -> Callable[[], Any]:
        from tests.scene.importing import write_ply

        table = self._table(case)
        table.write_bytes(self._spoiled(table.read_bytes(), draw, (*damage.BYTES, *damage.TEXT)))
        return self._import(write_ply(case / "wall.ply"), table)

    @staticmethod
    def _table(case: Path) -> Path:
        table = case / "materials.toml"
        table.write_text(
            'metre = 1.0\nup = "z"\n[materials]\n"*" = { itu = "brick", thickness = 0.2 }\n'
        )
        return table

    # what the sandbox sends

    def message(self, case: Path, draw: Random) -> Callable[[], Any]:
        from rfsg.scene import wire
        from rfsg.scene.scene import Scene, SceneError

        if not hasattr(self, "sent"):
            scene = Scene.from_usd(self.home / "scenes" / "lab.usda")
            self.sent = wire.packed(*wire.scene_message(scene))
        ways = (*damage.BYTES, damage.other_numbers)
        data = self._spoiled(self.sent, draw, ways)

        def look() -> None:
            try:
                message = wire.unpacked(data)
            except wire.REFUSALS as error:
                raise SceneError([f"{case}: {error}"]) from error
            wire.scene_of(message, str(case))

        return look


def main() -> None:
    folder = Path(sys.argv[1])
    out = os.fdopen(os.dup(1), "w")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1), os.dup2(nowhere, 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    corpus, opened = Corpus(folder), _watched(folder)
    warnings.simplefilter("ignore")
    from rfsg.learn.errors import MeasurementError
    from rfsg.scene.errors import SceneError

    names = list(corpus.kinds)
    for line in sys.stdin:
        seed = int(line)
        corpus.spoils = seed >= 0
        draw, kind = Random(seed), names[seed % len(names)]
        case = corpus.home / f"case_{seed}"
        case.mkdir(exist_ok=True)
        look = corpus.kinds[kind](case, draw)
        signal.setitimer(signal.ITIMER_PROF, HANG)
        signal.alarm(WAIT)
        opened.clear()
        try:
            found = look()
            outcome = f"read the canary: {found}" if MARK in repr(found) else "read"
        except (SceneError, MeasurementError) as error:
            outcome = f"read the canary: {error}" if MARK in str(error) else "refused"
        except Exception as error:
            outcome = f"{type(error).__name__}: {error}"[:500]
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)
        told = {"seed": seed, "kind": kind, "outcome": outcome, "opened": sorted(set(opened))}
        print(json.dumps(told), file=out, flush=True)
        shutil.rmtree(case, ignore_errors=True)


def _watched(folder: Path) -> list[str]:
    """A list that fills with the files that Python opens and should not have."""
    opened: list[str] = []
    fine = [
        os.path.realpath(p)
        for p in (folder / "in", sys.prefix, sys.base_prefix, REPOSITORY, "/usr")
    ]
    fine += [os.path.realpath(p) for p in ("/proc/self", "/proc/cpuinfo", os.devnull)]

    def hook(event: str, arguments: tuple) -> None:
        if event == "open" and isinstance(arguments[0], (str, bytes)):
            real = os.path.realpath(os.fsdecode(arguments[0]))
            # OpenUSD's packages are written in a temporary folder before they are looked at
            if not any(real == p or real.startswith(p + os.sep) for p in fine):
                opened.append(real)

    sys.addaudithook(hook)
    return opened


if __name__ == "__main__":
    main()
