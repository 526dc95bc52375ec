"""The command line: what it understands, what it writes, what it says when something is wrong."""

import json
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import typer

from rfsg import cli
from rfsg.cli import app, parse

SCENE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Z"
)
def Xform "World"
{
    custom double rfsg:frequencyHz = 2440000000
    def Scope "Materials"
    {
        def Material "Metal"
        {
            custom token rfsg:material:model = "conductor"
        }
    }
    def Cube "Cabinet" (
        prepend apiSchemas = ["MaterialBindingAPI"]
    )
    {
        double size = 1
        float3[] extent = [(-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)]
        rel material:binding = </World/Materials/Metal>
        double3 xformOp:translate = (2, 2, 1)
        double3 xformOp:scale = (1, 0.5, 2)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
    }
    def Xform "AP"
    {
        custom token rfsg:radio:role = "tx"
        custom double rfsg:radio:powerDbm = 20
        double3 xformOp:translate = (0, 0, 1)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Xform "rx_0"
    {
        custom token rfsg:radio:role = "rx"
        double3 xformOp:translate = (4, 0, 1)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
"""


@pytest.fixture
def scene_file(tmp_path):
    file = tmp_path / "scene.usda"
    file.write_text(SCENE)
    return file


@pytest.fixture
def faked(monkeypatch, small_run, tmp_path):
    """The command line alone: the scene and the result are those made by hand."""
    import rfsg.tracer.radiomap  # noqa: F401  it would keep the made-up simulate, if first loaded now
    from rfsg.scene.scene import Scene

    asked = {}

    def simulate(scene, frequency, quality, **options):
        asked.update(scene=scene, frequency=frequency, quality=quality, **options)
        options["progress"]("search")
        return small_run

    def read(path, **options):
        asked["reading"] = options
        return small_run.scene

    monkeypatch.setattr(Scene, "from_usd", staticmethod(read))
    monkeypatch.setattr("rfsg.tracer.simulate.simulate", simulate)
    asked["file"] = tmp_path / "made_by_hand.usda"
    asked["file"].write_text("#usda 1.0\n")
    return asked


@pytest.mark.parametrize(
    ("text", "hertz"),
    [("2.44GHz", 2.44e9), ("868 MHz", 868e6), ("2.44e9", 2.44e9), ("5.8ghz", 5.8e9)]
    + [("100kHz", 1e5), ("1.5e2 Hz", 150.0), ("0.3THz", 3e11)],
)
def test_frequencies_have_units(text, hertz):
    assert parse.parse_frequency(text) == pytest.approx(hertz, rel=1e-15)


@pytest.mark.parametrize(
    "text", ["", "GHz", "-1GHz", "0", "nan", "inf", "1.2.3GHz", "2 m", "9e9GHz"]
)
def test_what_is_not_a_frequency_is_refused(text):
    with pytest.raises(typer.BadParameter, match="frequency"):
        parse.parse_frequency(text)


def test_frequencies_come_in_lists_and_again():
    found = parse.parse_frequencies(["2.4GHz,5GHz", "60 GHz"])
    assert found == pytest.approx([2.4e9, 5e9, 60e9]) and parse.parse_frequencies([]) == []
    with pytest.raises(typer.BadParameter, match="frequency"):
        parse.parse_frequencies(["2.4GHz,"])
    with pytest.raises(typer.BadParameter, match="at most"):
        parse.parse_frequencies(["1GHz," * 20_000 + "1GHz"])


@pytest.mark.parametrize(
    ("text", "seconds"), [("10ms", 0.01), ("2.5 us", 2.5e-6), ("1e-3", 1e-3), ("3S", 3.0)]
)
def test_durations_have_units(text, seconds):
    assert parse.parse_duration(text) == pytest.approx(seconds, rel=1e-15)


@pytest.mark.parametrize("text", ["", "ms", "-1s", "0", "inf", "1min", "1e400"])
def test_what_is_not_a_duration_is_refused(text):
    with pytest.raises(typer.BadParameter, match="duration"):
        parse.parse_duration(text)


def test_planes_and_variants_are_read():
    plane = parse.parse_plane("0,2,0.5:1,0,0:0,0,2")
    assert plane.translation.tolist() == [0.0, 2.0, 0.5]
    assert plane.rotation.T.tolist() == [[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]
    for wrong in ("0,0,0", "0,0,0:1,0,0:2,0,0", "0,0,0:1,0:0,1,0", "0,0,nan:1,0,0:0,1,0"):
        with pytest.raises(typer.BadParameter):
            parse.parse_plane(wrong)
    texts = ["/World/Door:state=open", "/World/Door:look=red", "/A:b=c"]
    assert parse.parse_variants(texts) == {
        "/World/Door": {"state": "open", "look": "red"},
        "/A": {"b": "c"},
    }
    for wrong in ("/World/Door", "/World/Door:state", ":state=open", "/A:=b"):
        with pytest.raises(typer.BadParameter, match="PRIM:SET=NAME"):
            parse.parse_variants([wrong])


def test_moves_and_additions_are_read():
    assert parse.parse_move("/World/A=1,2,3") == ("/World/A", (1.0, 2.0, 3.0), 0.0)
    assert parse.parse_move("/World/A = 1, 2, 3, -90") == ("/World/A", (1.0, 2.0, 3.0), -90.0)
    found = parse.parse_addition("/World/A=b@home/a.usda@1,2,3,45")
    assert found == ("/World/A", "b@home/a.usda", (1.0, 2.0, 3.0), 45.0)
    for wrong in ("/World/A=a.usda", "/World/A=@1,2,3", "a.usda@1,2,3", "/World/A=a.usda@1,2"):
        with pytest.raises(typer.BadParameter):
            parse.parse_addition(wrong)


def test_quality_fields_keep_their_types():
    quality = parse.parse_quality("draft", ["depth=4", "epsilon=0.02", "integral=riemann"])
    assert (quality.depth, quality.epsilon, quality.integral) == (4, 0.02, "riemann")
    for wrong in ("depth=deep", "nonsense=1", "depth"):
        with pytest.raises(typer.BadParameter):
            parse.parse_quality("draft", [wrong])


def test_simulate_writes_everything(faked, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["simulate", str(faked["file"]), "--out", str(out), "--frequency", "1GHz"]
    edits = ["--move", "/World/Wall=1,0,-0.5", "--without", "/World/Ball", "--set", "depth=1"]
    assert cli.run([*arguments, *edits]) == 0
    names = {"links.csv", "paths.csv", "channel.npz", "report.json", "scene.png", "pdp.png"}
    assert {file.name for file in out.iterdir()} == names
    report = json.loads((out / "report.json").read_text())
    assert report["move"] == ["/World/Wall=1,0,-0.5"] and report["seed"] == 0
    assert faked["frequency"].tolist() == [1e9] and faked["quality"].depth == 1
    plain = {"asset_roots": [], "variants": {}, "time": None, "untrusted": False}
    assert faked["reading"] == plain
    (wall,) = faked["scene"].nodes
    assert wall.pose.translation.tolist() == [3.0, 3.0, 1.0]
    printed = capsys.readouterr()
    assert str(out / "scene.png") in printed.out and "/World/rx_1" in printed.out
    assert printed.err == "note: a warning\n"  # piped: no progress bar


def test_responses_over_band_and_time_are_written(faked, tmp_path):
    out = tmp_path / "out"
    arguments = ["simulate", str(faked["file"]), "--out", str(out), "--frequency", "1GHz,2GHz"]
    options = ["--bandwidth", "20MHz", "--subcarriers", "16", "--snapshots", "4"]
    assert cli.run([*arguments, "--frequency", "3GHz", *options, "--duration", "2ms"]) == 0
    assert faked["frequency"].tolist() == [1e9, 2e9, 3e9]
    with np.load(out / "channel.npz", allow_pickle=False) as stored:  # the made-up run has one f
        assert stored["cfr"].shape == (1, 2, 1, 4, 16)
        assert stored["taps"].shape[:4] == (1, 2, 1, 4)
        assert stored["time"].tolist() == pytest.approx([0.0, 5e-4, 1e-3, 1.5e-3])
    report = json.loads((out / "report.json").read_text())
    assert (report["bandwidth_hz"], report["subcarriers"], report["duration_s"]) == (2e7, 16, 2e-3)


def test_reading_options_reach_the_reader(faked, tmp_path):
    arguments = ["simulate", str(faked["file"]), "--out", str(tmp_path / "o")]
    options = ["--asset-root", str(tmp_path), "--variant", "/World/Door:state=open", "--time", "24"]
    assert cli.run([*arguments, *options, "--untrusted"]) == 0
    expected = {"asset_roots": [tmp_path], "variants": {"/World/Door": {"state": "open"}}}
    assert faked["reading"] == expected | {"time": 24.0, "untrusted": True}


def test_receivers_come_from_a_table(faked, tmp_path):
    table = tmp_path / "places.csv"
    table.write_text("name,x,y,z\nbench,1,2,3\n")
    arguments = ["simulate", str(faked["file"]), "--out", str(tmp_path / "o")]
    cli.run([*arguments, "--receivers", str(table)])
    (receiver,) = faked["scene"].receivers
    assert receiver.path.endswith("/bench") and receiver.position.tolist() == [1.0, 2.0, 3.0]


def test_results_are_not_overwritten_unasked(faked, tmp_path, capsys):
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / "notes.txt").write_text("mine")
    arguments = ["simulate", str(faked["file"]), "--out", str(tmp_path / "o")]
    assert cli.run(arguments) == 2
    assert "--overwrite" in capsys.readouterr().err and "scene" not in faked
    assert cli.run([*arguments, "--overwrite"]) == 0
    assert (tmp_path / "o" / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["simulate", "FILE"], 2, "--out"),
        (["simulate", "FILE", "--out", "o", "--quality", "best"], 2, "draft, standard, reference"),
        (["simulate", "FILE", "--out", "o", "--move", "/World/Wall"], 2, "PATH=x,y,z"),
        (["simulate", "FILE", "--out", "o", "--move", "/World/Wall=1,2"], 2, "three numbers"),
        (["simulate", "FILE", "--out", "o", "--move", "/World/Wal=1,2,3"], 3, "/World/Wal:"),
        (["simulate", "FILE", "--out", "o", "--without", "/Nothing"], 3, "/Nothing"),
        (["simulate", "FILE", "--out", "o", "--replace", "/World/Wall=no.usda"], 3, "no.usda"),
        (["simulate", "FILE", "--out", "o", "--swap", "/World/Wall=no.usda"], 3, "no.usda"),
        (["simulate", "FILE", "--out", "o", "--remove", "/Nothing"], 3, "/Nothing"),
        (["simulate", "FILE", "--out", "o", "--move", "/World/Wall=1,2,3,4,5"], 2, "degrees"),
        (["simulate", "FILE", "--out", "o", "--add", "/World/X=no.usda@1,2,3"], 3, "no.usda"),
        (["simulate", "FILE", "--out", "o", "--add", "/World/X=no.usda"], 2, "PATH=ASSET@x,y,z"),
        (["map", "FILE", "--out", "o", "--add", "/World/X=a@b.usda@1,2"], 2, "three numbers"),
        (["map", "FILE", "--out", "o", "--save", "FILE"], 2, "--overwrite"),
        (["tradeoff", "FILE", "--out", "o", "--save", "FILE"], 2, "--overwrite"),
        (["simulate", "FILE", "--out", "o", "--save", "e.usda"], 3, "made in Python"),
        (["simulate", "FILE", "--out", "o", "--link", "/A=/B"], 2, "/World/AP=/World/rx_0"),
        (["simulate", "FILE", "--out", "o", "--device", "abacus"], 2, "abacus"),
        (["simulate", "nowhere.usda", "--out", "o"], 3, "nowhere.usda"),
        (["learn-shape", "nowhere.obj", "-o", "a.usda"], 3, "nowhere.obj"),
        (["learn-shape", "FILE", "-o", "a.usda", "--up", "W"], 2, "--up"),
        (["simulate", "FILE", "--out", "o", "--frequency", "2.4GHz,five"], 2, "'five'"),
        (["simulate", "FILE", "--out", "o", "--subcarriers", "8"], 2, "--bandwidth"),
        (["simulate", "FILE", "--out", "o", "--snapshots", "8"], 2, "--duration"),
        (["simulate", "FILE", "--out", "o", "--duration", "1ms"], 2, "--snapshots"),
        (["simulate", "FILE", "--out", "o", "--bandwidth", "4GHz"], 3, "below the carrier"),
        (["simulate", "FILE", "--out", "o", "--asset-root", "nowhere"], 2, "nowhere"),
        (["simulate", "FILE", "--out", "o", "--variant", "/A"], 2, "PRIM:SET=NAME"),
        (["simulate", "FILE", "--out", "o", "--time", "nan"], 2, "time code"),
        (["map", "FILE", "--out", "o", "--height", "1", "--on", "/World/Wall"], 2, "give one"),
        (
            ["map", "FILE", "--out", "o", "--on", "/World/Wall", "--bounds", "0,0,1,1"],
            2,
            "--bounds",
        ),
        (["map", "FILE", "--out", "o", "--plane", "0,0,0:1,0,0"], 2, "ORIGIN:U:V"),
        (["map", "FILE", "--out", "o", "--bounds", "0,0,1"], 2, "four numbers"),
        (["map", "FILE", "--out", "o", "--metric", "luck"], 2, "luck"),
        (["map", "FILE", "--out", "o", "--on", "/World/Wal"], 3, "/World/Wal:"),
        (["dance"], 2, "dance"),
    ],
)
def test_errors_are_one_sentence_and_a_code(
    faked, tmp_path, monkeypatch, capsys, arguments, code, words
):
    monkeypatch.chdir(tmp_path)
    assert cli.run([a.replace("FILE", str(faked["file"])) for a in arguments]) == code
    printed = capsys.readouterr()
    assert words in printed.err and "Traceback" not in printed.err
    assert printed.err.count("\n") == 1 and printed.err.startswith("rfsg: ")
    assert not (tmp_path / "o").exists()


def test_learn_shape_passes_its_options_on(monkeypatch, tmp_path, capsys):
    mesh, asked = tmp_path / "thing.obj", {}
    mesh.write_text("# a mesh\n")

    def learn(mesh_path, asset_path, **options):
        asked.update(options, mesh=mesh_path, asset=asset_path)
        options["progress"](1, 5, "surface error 3.00 mm")
        return SimpleNamespace(surface_mean_mm=1.25, steps=5)

    drawn: list[object] = []
    monkeypatch.setattr("rfsg.learn.geometry.learn_shape_file", learn)
    monkeypatch.setattr("rfsg.assets.illustrate", lambda asset, **_: drawn.append(asset))
    options = ["--steps", "5", "--scale", "0.01", "--up", "Y", "--fresh", "--seed", "7"]
    assert cli.run(["learn-shape", str(mesh), "-o", str(tmp_path / "a.usda"), *options]) == 0
    assert asked["steps"] == 5 and asked["scale"] == 0.01 and asked["up_axis"] == "y"
    assert asked["resume"] is False and asked["seed"] == 7 and asked["overwrite"] is False
    assert "surface_mean_mm" in capsys.readouterr().out and drawn == [tmp_path / "a.usda"]
    (tmp_path / "a.png").write_bytes(b"mine")
    assert cli.run(["learn-shape", str(mesh), "-o", str(tmp_path / "a.usda"), *options]) == 3
    assert "a.png: already exists" in capsys.readouterr().err and len(drawn) == 1


@pytest.mark.parametrize(
    ("error", "code"), [(FloatingPointError("singular"), 4), (RuntimeError("a bug"), 1)]
)
def test_other_failures_have_their_codes(faked, tmp_path, monkeypatch, capsys, error, code):
    def fail(*arguments, **options):
        raise error

    monkeypatch.setattr("rfsg.tracer.simulate.simulate", fail)
    arguments = ["simulate", str(faked["file"]), "--out", str(tmp_path / "o")]
    assert cli.run(arguments) == code
    assert "Traceback" not in capsys.readouterr().err
    assert cli.run([*arguments, "--debug"]) == code
    assert "Traceback" in capsys.readouterr().err


def test_other_tools_layouts_lie_beside_the_rest(faked, tmp_path):
    arguments = ["simulate", str(faked["file"]), "--out", str(tmp_path / "o"), "--overwrite"]
    for _ in range(2):  # the second time over what is there
        assert cli.run([*arguments, "--channel", "sionna", "--channel", "deepmimo"]) == 0
    with np.load(tmp_path / "o" / "cir.npz") as found:
        assert found["a"].shape[:5] == (1, 2, 1, 1, 1)
    assert (tmp_path / "o" / "deepmimo" / "params.json").is_file()


@pytest.mark.parametrize("command", app.COMMANDS)
def test_help_answers_for_every_command(command, capsys):
    assert cli.run([command, "--help"]) == 0
    assert command in capsys.readouterr().out


def test_a_real_scene_from_file_to_files(scene_file, tmp_path):
    """Through the installed entry point, piped: line of sight and one bounce off the cabinet."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "rfsg.cli", "simulate", str(scene_file), "--out", str(out)]
    done = subprocess.run([*command, "--quality", "draft"], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    rows = (out / "paths.csv").read_text().splitlines()
    assert len(rows) == 3 and "line_of_sight" in rows[1] and "reflection(/World/Cabinet)" in rows[2]


@pytest.fixture
def post(tmp_path):
    """An asset: a screen of metal."""
    from rfsg.objects.body import Body
    from rfsg.objects.shapes.analytic import Box
    from rfsg.objects.surfaces.interface import Conductor
    from rfsg.scene.assets import save_asset

    return save_asset(tmp_path / "post.usda", Body(Box((1.0, 0.1, 1.0)), Conductor()))


def test_edits_are_kept_as_a_layer_that_gives_the_same_results(scene_file, post, tmp_path, capsys):
    source, saved = scene_file.read_bytes(), tmp_path / "edits.usda"
    edits = ["--swap", f"/World/Cabinet={post}", "--add", f"/World/New/P={post}@2,-1,1,5"]
    edits += ["--move", "/World/Cabinet=0.5,0,0,10", "--move", "/World/AP=0,0,0.25"]
    options = ["--quality", "draft", "--out"]
    arguments = ["simulate", str(scene_file), *edits, "--save", str(saved)]
    assert cli.run([*arguments, *options, str(tmp_path / "a")]) == 0
    printed = capsys.readouterr()
    assert str(saved) in printed.out and printed.err == ""
    assert scene_file.read_bytes() == source
    assert cli.run(["simulate", str(saved), *options, str(tmp_path / "b")]) == 0
    one, other = ((tmp_path / o / "links.csv").read_text().splitlines() for o in "ab")
    assert one == other and len(one) == 2
    one, other = ((tmp_path / o / "paths.csv").read_text() for o in "ab")
    assert "/World/New/P" in one and [r.split(",")[:5] for r in one.splitlines()] == [
        r.split(",")[:5] for r in other.splitlines()
    ]
    report = json.loads((tmp_path / "a" / "report.json").read_text())
    assert report["save"] == str(saved) and report["add"] == [edits[3]]
    assert cli.run([*arguments, *options, str(tmp_path / "c")]) == 2  # it is there now
    assert "--overwrite" in capsys.readouterr().err
    gone = ["map", str(saved), "--remove", "/World/New", "--cell", "1", "--set", "map_rays=2000"]
    more = ["--save", str(tmp_path / "more.usda"), "--out", str(tmp_path / "d")]
    assert cli.run([*gone, "--quality", "draft", *more]) == 0
    assert "active = false" in (tmp_path / "more.usda").read_text()
    assert cli.run(["info", str(tmp_path / "more.usda")]) == 0
    assert "/World/New" not in capsys.readouterr().out


def test_edit_writes_a_layer_and_says_what_its_readers_need(scene_file, post, tmp_path, capsys):
    from rfsg.cli.edit import edit

    alone = typer.Typer()
    alone.command("edit")(edit)
    saved = tmp_path / "far" / "edits.usda"
    saved.parent.mkdir()
    alone([str(scene_file), "--remove", "/World/Cabinet", "-o", str(saved)], standalone_mode=False)
    printed = capsys.readouterr()
    assert printed.out == f"{saved}: the edits, as a layer over the scene\n"
    assert printed.err.startswith("note: ") and str(tmp_path) in printed.err
    assert cli.run(["info", str(saved)]) == 3
    assert cli.run(["info", str(saved), "--asset-root", str(tmp_path)]) == 0
    with pytest.raises(typer.BadParameter, match="--overwrite"):
        alone([str(scene_file), "--save", str(saved)], standalone_mode=False)


def test_a_map_of_a_real_scene(scene_file, tmp_path, capsys):
    out = tmp_path / "map"
    arguments = ["map", str(scene_file), "--out", str(out), "--cell", "1", "--quality", "draft"]
    assert cli.run([*arguments, "--transmitter", "/World/Nobody"]) == 2
    assert "/World/AP" in capsys.readouterr().err
    assert cli.run([*arguments, "--set", "map_rays=2000"]) == 0
    assert {file.name for file in out.iterdir()} == {"map.npz", "map.png", "report.json"}
    with np.load(out / "map.npz", allow_pickle=False) as stored:
        size = (1, len(stored["y"]), len(stored["x"]))
        assert stored["path_gain"].shape == stored["error_db"].shape == size
        assert stored["origin"].tolist() == [0.0, 0.0, 1.2]
        assert not np.isnan(stored["path_gain"]).any()
    report = json.loads((out / "report.json").read_text())
    assert any("rays" in line for line in report["modelled"])
    assert any("diffraction" in line for line in report["left_out"])


def test_maps_on_other_planes_and_on_objects(scene_file, tmp_path):
    arguments = ["map", str(scene_file), "--quality", "draft", "--set", "map_rays=2000"]
    upright = ["--plane", "0,1,0:1,0,0:0,0,1", "--bounds", "0,0,4,2", "--metric", "sinr"]
    options = ["--bandwidth", "1MHz", "--noise-figure", "5", "--method", "paths"]
    assert cli.run([*arguments, "--out", str(tmp_path / "a"), *upright, *options]) == 0
    with np.load(tmp_path / "a" / "map.npz", allow_pickle=False) as stored:
        assert stored["path_gain"].shape == (1, 4, 8) and stored["v"].tolist() == [0, 0, 1]
        noise = -173.975 + 60.0 + 5.0
        heard = np.isfinite(stored["rss_dbm"])
        expected = (stored["rss_dbm"] - noise)[heard]
        assert stored["sinr_db"][heard] == pytest.approx(expected, abs=1e-3)
    on = ["--on", "/World/Cabinet", "--cell", "0.7", "--metric", "best-server"]
    assert cli.run([*arguments, "--out", str(tmp_path / "b"), *on]) == 0
    with np.load(tmp_path / "b" / "map.npz", allow_pickle=False) as stored:
        # a cabinet of 1 x 0.5 x 2 m
        assert stored["area"].sum() == pytest.approx(2 * (0.5 + 1.0 + 2.0))
        facing = stored["normal"][:, 1] < -0.5  # the side before the transmitter
        assert np.isfinite(stored["rss_dbm"][0, facing]).all()
    report = json.loads((tmp_path / "b" / "report.json").read_text())
    assert (report["method"], report["on"]) == ("paths", "/World/Cabinet")


def test_check_and_info(scene_file, capsys):
    assert cli.run(["check", str(scene_file)]) == 0
    assert cli.run(["info", str(scene_file)]) == 0
    printed = capsys.readouterr().out
    assert "/World/Cabinet" in printed and "conductor" in printed and "2.44 GHz" in printed
    scene_file.write_text(SCENE.replace('"conductor"', '"jelly"'))
    assert cli.run(["check", str(scene_file)]) == 3
    assert "jelly" in capsys.readouterr().out
