"""Files of strangers in a child process: what comes back is what was there, and whatever the child does
is a sentence. What crosses between the processes is believed in nothing."""

import copy
import json
import random
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from rfsg.cli.app import run
from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box
from rfsg.objects.shapes.mesh import Mesh
from rfsg.objects.surfaces.interface import Conductor
from rfsg.scene import sandbox, wire
from rfsg.scene.arrays import Array
from rfsg.scene.importers.api import imported_file
from rfsg.scene.importers.sent import imported_message, imported_of
from rfsg.scene.patterns import Pattern
from rfsg.scene.pose import Pose
from rfsg.scene.radios import Radio
from rfsg.scene.scene import Node, Scene, SceneError
from rfsg.scene.usd.kept import alike
from rfsg.scene.weights import same_bits
from tests.scene.scene_text import cube

ASSETS = Path(__file__).parents[2] / "assets"
QUICK = sandbox.Limits(seconds=60)
ALLOW_DEEP = "import rfsg.scene.files as f; f.MAX_NESTING = 10**9"
MAIN = "from rfsg.scene import sandbox; {change}; sandbox.main()"


@pytest.fixture
def child(monkeypatch):
    """child("code") makes the child run that instead of itself."""

    def replaced(code: str) -> None:
        monkeypatch.setattr(sandbox, "CHILD", ("-c", code))

    return replaced


def sentence(path="scene.usda", limits=QUICK, job=sandbox.read, **options) -> str:
    with pytest.raises(SceneError) as error:
        job(path, limits, **options)
    (fault,) = error.value.faults
    assert fault.startswith(str(Path(path).absolute()))
    return fault


def refused(path, **options) -> tuple[str, ...]:
    with pytest.raises(SceneError) as error:
        Scene.from_usd(path, **options)
    return error.value.faults


def same(a: Scene, b: Scene) -> bool:
    """Whether two scenes hold the same to the bit, and share bodies and surfaces alike."""
    for x, y in zip(a.nodes, b.nodes, strict=True):
        parts = (x.path, y.path), (x.velocity, y.velocity), (x.pose, y.pose)
        assert all(alike(*pair) for pair in parts)
        assert same_bits(x.body.shape, y.body.shape)
        assert same_bits(x.body.surface, y.body.surface)
        assert x.body.band == y.body.band
    for get in (lambda n: n.body, lambda n: n.body.shape, lambda n: n.body.surface):
        shared = [[id(get(n)) == id(get(m)) for n in s.nodes for m in s.nodes] for s in (a, b)]
        assert shared[0] == shared[1]
    radios = zip((*a.transmitters, *a.receivers), (*b.transmitters, *b.receivers), strict=True)
    assert all(alike(x, y) for x, y in radios)
    return (a.frequency, a.warnings) == (b.frequency, b.warnings)


# in one process


def everything() -> Scene:
    """A scene with one of each kind of thing that a message holds."""
    turned = Pose.at(1.0, 2.0, 3.0, 33.0, 0.7)
    mirror = Pose(turned.rotation @ torch.diag(torch.tensor([1.0, -1, 1])).double(),
                  turned.translation, turned.scale)  # fmt: skip
    metal, box = Conductor(), Box([0.5, 0.25, 1.0])
    height = (
        np.random.default_rng(0).random((40, 40)) / 10
    )  # more rows than a declared width may be
    x, y = np.meshgrid(np.arange(40.0), np.arange(40.0), indexing="ij")
    corner = np.arange(1600).reshape(40, 40)
    low, right, up = corner[:-1, :-1], corner[1:, :-1], corner[:-1, 1:]
    terrain = Mesh(
        np.stack([x, y, height], -1).reshape(-1, 3),
        np.stack([low, right, up], -1).reshape(-1, 3),
        sheet=True,
    )
    learned = Body(box, metal, band=(2e9, 3e9))
    nodes = (
        Node("/World/A", learned, turned),
        Node("/World/B", learned, mirror, torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)),
        Node("/World/C", Body(box, metal), Pose.identity()),
        Node("/World/D", Body(terrain, metal), Pose.identity()),
    )
    theta, phi = np.linspace(0, 180, 7), np.linspace(-180, 170, 36)
    draw = np.random.default_rng(1)
    gain = torch.from_numpy(0.5 + draw.random((7, 36)))
    field = torch.from_numpy(draw.random((7, 36, 2)) + 1j * draw.random((7, 36, 2)))
    plain = Pattern.from_samples("plain", theta, phi, gain)
    vector = Pattern.from_samples("vector", theta, phi, field)
    tx = (
        Radio.at("/World/T", 1, 2, 3, 10.0, pattern=plain, array=Array.planar(2, 3), frequency=3e9),
        Radio.at("/World/U", 1, 2, 3, pattern=plain, polarization="VH", power_dbm=12.5),
    )
    offsets = torch.tensor([[0.0, 0.1, 0.2], [0.0, 0.3, 0.7]], dtype=torch.float64)
    rx = (Radio.at("/World/R", 0, 0, 1, pattern=vector, array=Array(offsets, "m")),)
    return Scene(nodes, tx, rx, 2.4e9, ("a warning",))


@pytest.mark.parametrize("name", ["lab", "tetam_lab", "materials"])
def test_a_scene_crosses_bit_by_bit(name):
    scene = Scene.from_usd(ASSETS / "scenes" / f"{name}.usda")
    message = wire.unpacked(wire.packed(*wire.scene_message(scene)))
    assert same(wire.scene_of(message, "here"), scene)


def test_arrays_patterns_bands_mirrors_and_sheets_cross_too():
    scene = everything()
    message = wire.unpacked(wire.packed(*wire.scene_message(scene)))
    back = wire.scene_of(message, "here")
    assert same(back, scene)
    assert back.transmitters[0].array.layout == (2, 3, 0.5, 0.5)
    assert back.transmitters[0].pattern is back.transmitters[1].pattern


def _places(value, path=()):
    """Paths to every number, text and list in a head."""
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, inner in items if isinstance(value, (dict, list, tuple)) else ():
        if isinstance(inner, (dict, list, tuple)):
            yield from _places(inner, (*path, key))
        else:
            yield (*path, key)


def test_a_message_that_lies_is_refused_or_is_a_scene():
    """A child that was taken over can send anything: each value in turn is replaced, and bytes are."""
    head, blobs = wire.scene_message(everything())
    head = json.loads(json.dumps(head))
    draw = random.Random(0)
    lies = [None, -1, 10**9, 1e300, "x", "\x1b[2J", [], {}, True, [[0.0]]]
    for place in draw.sample([p for p in _places(head) if p], 60):
        lying = at = copy.deepcopy(head)
        for key in place[:-1]:
            at = at[key]
        at[place[-1]] = draw.choice(lies)
        _only_scene_errors(lying, blobs)
    for number in range(len(blobs)):
        for _ in range(5):
            broken = bytearray(blobs[number])
            broken[draw.randrange(len(broken))] ^= 1 << draw.randrange(8)
            _only_scene_errors(head, [*blobs[:number], bytes(broken), *blobs[number + 1 :]])


def _only_scene_errors(head, blobs):
    try:
        scene = wire.scene_of((head, blobs), "here")
    except SceneError:
        return
    for thing in (*scene.nodes, *scene.transmitters, *scene.receivers):
        assert thing.path.startswith("/") and thing.path.isprintable()
        assert bool(thing.velocity.isfinite().all())
    assert all(w.isprintable() for w in scene.warnings)


@pytest.mark.parametrize(
    "data",
    [b"", b"short", (2**40).to_bytes(8, "little"), (2).to_bytes(8, "little") + b"[]",
     (13).to_bytes(8, "little") + b'{"sizes":[9]}', (12).to_bytes(8, "little") + b'{"sizes":[]}..'],
)  # fmt: skip
def test_bytes_that_are_no_message(data):
    with pytest.raises(wire.REFUSALS):
        wire.unpacked(data)


PLAN = {
    "materials": {"brick": {"itu": "brick"}},
    "features": [{"line": [[0, 0], [4, 0]], "material": "brick", "name": "Wall"}],
}


@pytest.fixture
def plan(tmp_path) -> Path:
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(PLAN))
    return path


def test_what_importers_find_crosses_bit_by_bit(plan):
    found = imported_file(plan, None, None, None)
    head, blobs = wire.unpacked(wire.packed(*imported_message(found)))
    back = imported_of((head, blobs), str(plan))
    assert back.materials == found.materials and back.warnings == found.warnings
    for a, b in zip(back.parts, found.parts, strict=True):
        assert (a.name, a.material, a.sheet, a.ball) == (b.name, b.material, b.sheet, b.ball)
        assert np.array_equal(a.vertices, b.vertices) and np.array_equal(a.triangles, b.triangles)
    for change in ({"material": "gold"}, {"vertices": 1}, {"name": 3}, {"ball": [[0, 0], 1]}):
        lying = head | {"parts": [head["parts"][0] | change]}
        with pytest.raises(SceneError, match="sent what is no scene"):
            imported_of((lying, blobs), str(plan))


# what a child can do


@pytest.mark.parametrize(
    "code, expected",
    [
        ("import os; os.abort()", "ends its process (SIGABRT)"),
        ("import os; os.kill(os.getpid(), 11)", "ends its process (SIGSEGV)"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGXCPU)", "takes more than 60 s"),
        ("import sys; sys.exit(3)", "ended with status 3"),
        ("pass", "sent no answer"),
        ("import os, sys; os.write(int(sys.argv[1]), b'x' * 9000)", "sent no answer"),
        ("import os, sys\nwhile True: os.write(int(sys.argv[1]), bytes(2**16))", "more than one"),
    ],
)
def test_whatever_the_child_does_is_a_sentence(child, monkeypatch, code, expected):
    monkeypatch.setattr(wire, "MAX_BYTES", 2**20)
    child(code)
    assert expected in sentence()


@pytest.mark.parametrize("first", ["pass", "import os, sys; os.close(int(sys.argv[1]))"])
def test_a_child_that_hangs_is_ended(child, monkeypatch, first):
    monkeypatch.setattr(sandbox, "GRACE", 0.2)
    child(f"{first}\nimport time; time.sleep(600)")
    assert "takes more than 0.5 s" in sentence(limits=sandbox.Limits(seconds=0.5))


def test_a_file_that_kills_the_reader_of_usd_does_not_kill_us(child, tmp_path):
    """100,000 nested prims, past the check that refuses them: OpenUSD overruns its stack."""
    path = tmp_path / "deep.usda"
    path.write_text("#usda 1.0\n" + 'def "x" {\n' * 100_000 + "}\n" * 100_000)
    child(MAIN.format(change=ALLOW_DEEP))
    assert "ends its process (SIG" in sentence(path)
    child(MAIN.format(change="pass"))
    assert "prims nest more than" in sentence(path)


def test_memory_has_an_end(child):
    child(MAIN.format(change="sandbox.JOBS['read'] = lambda **asked: bytearray(2**40)"))
    assert f"takes more than {QUICK.memory} bytes" in sentence()


def test_other_errors_are_the_files(child):
    child(MAIN.format(change="sandbox.JOBS['read'] = lambda **asked: 1 / 0"))
    assert sentence().endswith("ZeroDivisionError: division by zero")


@pytest.mark.slow  # it takes the time that it is given
def test_references_that_multiply_run_out_of_time(tmp_path):
    """Ten references in each of nine files: 10^9 prims."""
    head = (
        '#usda 1.0\n(\n defaultPrim = "X"\n metersPerUnit = 1\n upAxis = "Z"\n)\ndef Xform "X" {\n'
    )
    for k in range(9):
        body = "".join(f'def "r{i}" (references = @./b{k + 1}.usda@) {{}}\n' for i in range(10))
        (tmp_path / f"b{k}.usda").write_text(head + body + "}\n")
    (tmp_path / "b9.usda").write_text(head + "}\n")
    limits = sandbox.Limits(seconds=20, memory=2**31)
    fault = sentence(tmp_path / "b0.usda", limits)
    assert "takes more than 20 s" in fault or "bytes of memory" in fault


CONFINED = """
import json, os, socket, sys
from rfsg.scene import confine
port, inside, outside = int(sys.argv[1]), *sys.argv[2:]
def tried(step):
    try:
        step()
        return True
    except OSError:
        return False
alone, closed = confine.close_network(), confine.close_files([inside])
confine.limit(30, 2**32)
print(json.dumps({
    "alone": alone, "closed": closed,
    "inside": tried(lambda: open(inside + "/seen").read()),
    "outside": tried(lambda: open(outside).read()),
    "through a link": tried(lambda: open(inside + "/link").read()),
    "passwd": tried(lambda: open("/etc/passwd").read()),
    "writing": tried(lambda: os.write(os.open(inside + "/new", os.O_CREAT | os.O_WRONLY), b"x")),
    "network": tried(lambda: socket.create_connection(("127.0.0.1", port), 2)),
    "signals": tried(lambda: os.kill(os.getppid(), 0)),
    "python": tried(lambda: __import__("xml.dom.minidom")),
}))
"""


def test_the_child_reads_its_folders_and_nothing_else(tmp_path):
    """Asked of the kernel, not of our own checks: where it can confine, it does."""
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "seen").write_text("x")
    (tmp_path / "canary").write_text("x")
    (tmp_path / "in" / "link").symlink_to(tmp_path / "canary")
    with socket.create_server(("127.0.0.1", 0)) as server:
        arguments = [str(server.getsockname()[1]), str(tmp_path / "in"), str(tmp_path / "canary")]
        done = subprocess.run(
            [sys.executable, "-c", CONFINED, *arguments],
            capture_output=True, check=True, cwd=Path(__file__).parents[2],
        )  # fmt: skip
    found = json.loads(done.stdout)
    assert found["inside"] and found["python"] and not found["writing"]
    reached = [found[name] for name in ("outside", "through a link", "passwd")]
    assert reached == [not found["closed"]] * 3
    assert not (found["alone"] and found["network"])
    assert not (found["closed"] and found["network"] and found["signals"])


def test_a_system_that_cannot_confine_is_told():
    head, blobs = wire.scene_message(Scene())
    scene = wire.scene_of((head, blobs), "here")
    assert sandbox._warned(scene, ["files"]).warnings == (sandbox.UNCONFINED["files"],)
    assert sandbox._warned(scene, []).warnings == ()


def test_no_secret_goes_along(child, monkeypatch):
    monkeypatch.setenv("SECRET_TOKEN", "hush")
    child("import os, sys; sys.exit(9 if 'hush' in repr(os.environ) else 8)")
    assert "status 8" in sentence()


# the whole way


def test_a_scene_of_a_stranger_is_the_scene_without_its_file(scene_file, asset_here, tmp_path):
    net = f'def Xform "Net" (references = @./{asset_here.name}@) {{}}'
    radio = 'def Xform "Tx" {\n custom token rfsg:radio:role = "tx"\n}'
    path = scene_file("\n".join((cube(), net, radio)))
    plain, apart = Scene.from_usd(path), Scene.from_usd(path, untrusted=True)
    assert set(apart.warnings) <= set(plain.warnings) | set(sandbox.UNCONFINED.values())
    assert same(plain, Scene(apart.nodes, apart.transmitters, apart.receivers, apart.frequency,
                             plain.warnings))  # fmt: skip
    assert apart.source is None and all(node.asset is None for node in apart.nodes)
    assert all(getattr(node.body.shape, "folder", None) is None for node in apart.nodes)
    (tmp_path / "mine").mkdir()
    back = Scene.from_usd(apart.to_usd(tmp_path / "mine" / "copy.usda"))
    assert [n.path for n in back.nodes] == [n.path for n in apart.nodes]


def test_faults_come_through_as_they_are(scene_file):
    nan = cube("NaN", "double3 xformOp:translate = (nan, 0, 0)", '"xformOp:translate"')
    path = scene_file(nan + 'def Xform "R" {\n custom token rfsg:radio:role = "spy"\n}', metre=0)
    assert refused(path, untrusted=True) == refused(path)


def test_the_commands_take_the_option(plan, tmp_path, monkeypatch, capsys):
    asked = []
    ask = sandbox.ask
    monkeypatch.setattr(sandbox, "ask", lambda job, *rest: asked.append(job) or ask(job, *rest))
    out = tmp_path / "plan.usda"
    assert run(["import", str(plan), "-o", str(out), "--untrusted"]) == 0
    (tmp_path / "bad.usda").write_text("#usda 1.0\ndef {")
    assert run(["check", str(tmp_path / "bad.usda"), "--untrusted"]) == 3
    assert run(["info", str(out), "--untrusted"]) == 0
    assert asked == ["import", "check", "read"]
    assert "Wall" in capsys.readouterr().out
    assert run(["import", str(out), "-o", str(tmp_path / "o.usda"), "--untrusted"]) == 3


def test_what_the_child_started_ends_with_it(child):
    with socket.create_server(("127.0.0.1", 0)) as server:
        started = f"""
import socket, time
line = socket.create_connection(("127.0.0.1", {server.getsockname()[1]}))
line.send(b"x")
time.sleep(60)"""
        child(f"import subprocess, sys; p = subprocess.Popen([sys.executable, '-c', {started!r}])\n"
              "import time; time.sleep(1); sys.exit(5)")  # fmt: skip
        server.settimeout(30)
        assert "status 5" in sentence()
        line, _ = server.accept()
        line.settimeout(10)
        assert line.recv(9) in (b"", b"x")
        assert line.recv(9) == b""
