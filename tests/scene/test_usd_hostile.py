"""Hostile and broken scenes: every fault at once, each with its prim path, nothing on stderr."""

import json
import random
import shutil

import pytest
import torch
from safetensors.torch import load, save

from rfsg.scene import files, usd
from rfsg.scene.assets import load_asset
from rfsg.scene.scene import Scene, SceneError
from rfsg.scene.weights import digest, pack
from tests.scene.scene_text import cube, known


def faults_of(path, **options) -> tuple[str, ...]:
    with pytest.raises(SceneError) as error:
        Scene.from_usd(path, **options)
    return error.value.faults


def reference(target: str, name: str = "Thing") -> str:
    return f'def Xform "{name}" (\n        prepend references = {target}\n    )\n    {{\n    }}\n'


BAD_RADIO = """
    def Xform "Radio"
    {
        custom token rfsg:radio:role = "transmitter"
        custom token rfsg:radio:pattern = "yagi"
        custom double rfsg:radio:frequencyHz = -1
        custom string rfsg:radio:powerDbm = "20"
    }
"""


def test_all_faults_at_once_each_with_its_path_and_stderr_silent(scene_file, capfd):
    nan = cube("NaN", "double3 xformOp:translate = (nan, 0, 0)", '"xformOp:translate"')
    flat = cube("Flat", "double3 xformOp:scale = (1, 0, 1)", '"xformOp:scale"')
    body = nan + flat + BAD_RADIO + reference("@./missing.usda@", "Missing")
    body += reference("</World/Loop>", "Loop")
    faults = faults_of(scene_file(body, metre=0, up="Q"))
    text = "\n".join(faults)
    for expected in (
        "metersPerUnit is 0.0; expected a number > 0",
        "upAxis is 'Q'; expected Y or Z",
        "/World/NaN: the transform holds numbers that are not finite",
        "/World/Flat: the transform is singular",
        "/World/Radio: rfsg:radio:role is 'transmitter'; expected one of tx, rx",
        "/World/Radio: rfsg:radio:pattern is 'yagi'; expected one of isotropic, ",
        "/World/Radio: rfsg:radio:frequencyHz is -1.0; expected a finite number > 0",
        "/World/Radio: rfsg:radio:powerDbm is '20'; expected a finite number",
        "/World/Missing: Could not open asset",
        "/World/Loop: Cycle detected",
    ):
        assert expected in text
    assert all(f.startswith("/") and "\n" not in f for f in faults)
    assert capfd.readouterr() == ("", "")


def test_check_lists_the_same_faults_and_none_for_a_scene_in_order(scene_file, capfd):
    path = scene_file(BAD_RADIO)
    assert set(faults_of(path)) <= set(usd.check(path))
    assert usd.check(scene_file(cube())) == []
    assert capfd.readouterr().err == ""


def test_a_nan_in_an_ancestor_is_told_once_there(scene_file):
    body = f"""
    def Xform "Group"
    {{
        double3 xformOp:translate = (nan, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
        {cube("A")}{cube("B")}
    }}"""
    (fault,) = faults_of(scene_file(body))
    assert fault.startswith("/World/Group: the transform holds numbers that are not finite")


def test_a_projective_matrix_is_refused(scene_file):
    matrix = "( (1, 0, 0, 0.5), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1) )"
    body = cube(ops=f"matrix4d xformOp:transform = {matrix}", order='"xformOp:transform"')
    (fault,) = faults_of(scene_file(body))
    assert fault.startswith("/World/Wall: the transform is projective")


@pytest.mark.parametrize(
    "model, more, expected",
    [
        ("itu", "", "rfsg:material:model is 'itu'; expected one of conductor, "),
        ("slab", 'custom token rfsg:material:itu = "cheese"', "cheese"),
        ("slab", "", "needs itu, or epsR and sigma"),
        ("conductor", "custom double rfsg:material:thickness = 1", "takes no thickness"),
        ("halfspace", "custom double rfsg:material:epsR = 0.5", "eps_r"),
        ("slab", "custom double rfsg:material:epsR = nan", "expected a finite number > 0"),
    ],
)
def test_bad_materials(scene_file, model, more, expected):
    body = f"""
    def Cube "Wall"
    {{
        custom token rfsg:material:model = "{model}"
        {more}
    }}"""
    (fault,) = faults_of(scene_file(body))
    assert fault.startswith("/World/Wall: ") and expected in fault


@pytest.mark.parametrize("radius", ["0", "-1", "nan", "inf"])
def test_bad_sizes(scene_file, radius):
    (fault,) = faults_of(scene_file(known("Sphere", f"double radius = {radius}")))
    assert fault.startswith("/World/Thing: radius is") and "expected a number > 0" in fault


def test_a_slab_without_thickness_on_a_sphere(scene_file):
    body = """
    def Sphere "Ball"
    {
        custom token rfsg:material:model = "slab"
        custom token rfsg:material:itu = "wood"
    }"""
    (fault,) = faults_of(scene_file(body))
    assert fault == "/World/Ball: slab needs rfsg:material:thickness here"


def test_point_instancers_are_refused(scene_file):
    (fault,) = faults_of(scene_file('def PointInstancer "Trees" {}'))
    assert fault.startswith("/World/Trees: point instancers are not read")


# files


def test_missing_units_are_a_fault(tmp_path):
    path = tmp_path / "s.usda"
    path.write_text('#usda 1.0\n(\n    upAxis = "Z"\n)\ndef Xform "World" {\n}\n')
    (fault,) = faults_of(path)
    assert "metersPerUnit is missing" in fault


@pytest.mark.parametrize(
    "name, data, expected",
    [
        ("none.usda", None, "there is no such file"),
        ("empty.usda", b"", ""),
        ("junk.usda", b"\x00\xff junk", "not UTF-8 text: byte 1"),
        ("junk.usdc", b"PXR-USDC but no more", ""),
        ("junk.usdz", b"PK\x03\x04 but no more", "not a package"),
        ("scene.txt", b"#usda 1.0\n", "not a USD file"),
        ("cut.usda", b'#usda 1.0\ndef Xform "World" {\n  double x = ', "cut.usda:3"),
    ],
)
def test_files_that_are_no_scenes(tmp_path, capfd, name, data, expected):
    if data is not None:
        (tmp_path / name).write_bytes(data)
    (fault,) = faults_of(tmp_path / name)
    assert fault.startswith(f"{tmp_path / name}: ") and expected in fault
    assert capfd.readouterr().err == ""


def test_deep_nesting_is_refused_before_the_parser_dies_of_it(tmp_path):
    path = tmp_path / "deep.usda"
    deep = 'def Xform "x" {\n' * 100_000 + "}\n" * 100_000
    path.write_text("#usda 1.0\n" + deep)
    (fault,) = faults_of(path)
    assert f"prims nest more than {files.MAX_NESTING} deep" in fault


def test_braces_in_text_and_comments_are_not_nesting(scene_file, monkeypatch):
    monkeypatch.setattr(files, "MAX_NESTING", 5)
    text = 'custom string a = "{{{{{{" # {{{{{{\n    custom string b = """{{{{{{\n{{"""\n'
    assert Scene.from_usd(scene_file(text)).nodes == ()


def test_more_prims_than_the_limit(scene_file, monkeypatch):
    monkeypatch.setattr(usd.reading, "MAX_PRIMS", 3)
    assert any("more than 3 prims" in f for f in faults_of(scene_file(cube("A") + cube("B"))))


@pytest.mark.parametrize("how", ["reference", "payload", "sublayer", "absolute", "link"])
def test_layers_outside_the_scenes_folder_are_not_opened(tmp_path, scene_file, how, monkeypatch):
    inside, outside = tmp_path / "in", tmp_path / "out.usda"
    inside.mkdir()
    outside.write_text('#usda 1.0\n(\n    defaultPrim = "X"\n)\ndef Xform "X" {\n}\n')
    target = {"absolute": f"@{outside}@", "link": "@./link.usda@"}.get(how, "@../out.usda@")
    if how == "link":
        (inside / "link.usda").symlink_to(outside)
    body = reference(target).replace("references", "payload" if how == "payload" else "references")
    path = scene_file("" if how == "sublayer" else body, name="in/s.usda")
    if how == "sublayer":
        path.write_text(path.read_text().replace("(\n", f"(\n    subLayers = [{target}]\n", 1))
    (fault,) = faults_of(path)
    assert "lies outside the folders this scene may read" in fault
    assert how == "sublayer" or "</World/Thing>" in fault
    # named as a root, or under a marker in a common folder, it may be read
    assert Scene.from_usd(path, asset_roots=[tmp_path]).nodes == ()
    (tmp_path / files.MARKER).touch()
    assert Scene.from_usd(path).nodes == ()


@pytest.mark.parametrize("url", ["http://example.org/a.usda", "file:///etc/a.usda"])
def test_urls_are_refused(scene_file, url):
    (fault,) = faults_of(scene_file(reference(f"@{url}@")))
    assert "is a URL" in fault and "</World/Thing>" in fault


# weights


def neural(path: str, sha: str = "", extra: str = "") -> str:
    return f"""
    def Xform "Net"
    {{
        custom asset rfsg:neural:weights = @{path}@
        custom string rfsg:neural:sha256 = "{sha}"
        {extra}
    }}
"""


def net_faults(scene_file, tmp_path, data: bytes) -> tuple[str, ...]:
    (tmp_path / "net.safetensors").write_bytes(data)
    faults = faults_of(scene_file(neural("./net.safetensors", digest(data))))
    assert all(f.startswith("/World/Net: ./net.safetensors: ") for f in faults)
    return faults


def with_metadata(data: bytes, change) -> bytes:
    """The same tensors under a changed header."""
    size = int.from_bytes(data[:8], "little")
    head = json.loads(json.loads(data[8 : 8 + size])["__metadata__"]["rfsg"])
    change(head)
    return save(load(data), metadata={"rfsg": json.dumps(head)})


def with_tensors(data: bytes, change) -> bytes:
    size = int.from_bytes(data[:8], "little")
    tensors = load(data)
    change(tensors)
    return save(tensors, metadata=json.loads(data[8 : 8 + size])["__metadata__"])


def test_weights_in_order_are_read_straight_from_a_scene(scene_file, tmp_path, small_asset):
    data = pack(small_asset[0])
    (tmp_path / "net.safetensors").write_bytes(data)
    scene = Scene.from_usd(scene_file(neural("./net.safetensors", digest(data))))
    assert [n.path for n in scene.nodes] == ["/World/Net"]


def test_a_hash_that_does_not_match(scene_file, asset_here):
    (fault,) = faults_of(scene_file(neural("./cabinet.safetensors", "0" * 64)))
    assert fault.startswith("/World/Net: ") and "rfsg:neural:sha256 says" in fault


@pytest.mark.parametrize(
    "path, expected",
    [
        ("../secret.safetensors", "lies outside"),
        ("{absolute}", "lies outside"),
        ("./gone.safetensors", "not found"),
        ("https://example.org/net.safetensors", "is a URL"),
    ],
)
def test_weights_that_may_not_be_read(tmp_path, scene_file, small_asset, path, expected):
    (tmp_path / "in").mkdir()
    secret = tmp_path / "secret.safetensors"
    shutil.copy(small_asset[1].with_suffix(".safetensors"), secret)
    body = neural(path.format(absolute=secret), digest(secret.read_bytes()))
    (fault,) = faults_of(scene_file(body, name="in/s.usda"))
    assert fault.startswith("/World/Net: weights ") and expected in fault


def test_weights_are_never_looked_for_in_the_working_folder(
    scene_file, asset_here, tmp_path, monkeypatch
):
    body = neural("./cabinet.safetensors", "0" * 64)
    path = scene_file(body, name="scene.usda")
    (tmp_path / "deep").mkdir()
    path = path.rename(tmp_path / "deep" / "scene.usda")
    monkeypatch.chdir(tmp_path)  # holds a file of that name
    (fault,) = faults_of(path, asset_roots=[tmp_path])
    assert "not found" in fault


def test_a_newer_format_version(scene_file, asset_here):
    body = neural("./cabinet.safetensors", extra="custom int rfsg:neural:formatVersion = 2")
    (fault,) = faults_of(scene_file(body))
    assert "formatVersion is 2; this rfsg reads 1" in fault


@pytest.mark.parametrize(
    "data",
    [b"", b"short", (2**63).to_bytes(8, "little"), (2).to_bytes(8, "little") + b"{}", b"\x80\x04."],
)
def test_files_that_are_no_safetensors(scene_file, tmp_path, data):
    (fault,) = net_faults(scene_file, tmp_path, data)
    assert "not a safetensors file" in fault or "no readable rfsg metadata" in fault


def test_headers_that_declare_what_they_should_not(scene_file, tmp_path, small_asset):
    def set_config(part, **values):
        return lambda head: head[part]["config"].update(values)

    def set_kind(kind):
        return lambda head: head["shape"].update(kind=kind)

    for change, expected in (
        (set_config("shape", width=10**6), "the limit is 1024"),
        (set_config("shape", width=1000, depth=900), "too large a network"),
        (set_config("shape", color="red"), "cannot be built"),
        (set_kind("pickle"), "expected one of box, "),
        (lambda head: head.update(formatVersion=99), "format version 99"),
        (lambda head: head.pop("surface"), "declares no kind and config"),
    ):
        (fault,) = net_faults(scene_file, tmp_path, with_metadata(pack(small_asset[0]), change))
        assert expected in fault


def test_tensors_that_are_not_the_declared_architecture(scene_file, tmp_path, small_asset):
    data = pack(small_asset[0])
    name = next(k for k, v in load(data).items() if v.ndim == 2)

    def first_nan(tensors):
        tensors[name].view(-1)[0] = torch.nan

    for change, expected in (
        (lambda t: t.pop(name), "is missing"),
        (lambda t: t.update({"shape.more": torch.ones(1)}), "'shape.more' is unknown"),
        (lambda t: t.update({"more": torch.ones(1)}), "belongs to neither shape nor surface"),
        (lambda t: t.update({name: torch.ones(3)}), "has shape (3,)"),
        (lambda t: t.update({name: t[name].to(torch.int32)}), "has dtype torch.int32"),
        (first_nan, "not finite"),
    ):
        (fault,) = net_faults(scene_file, tmp_path, with_tensors(data, change))
        assert expected in fault


def test_random_damage_is_a_scene_error_or_a_scene(scene_file, tmp_path, capfd):
    """Bytes changed, lost and added in text and in binary layers: nothing else comes
    out, and of text nothing on stderr (the reader of binary layers has prints of its own)."""
    from pxr import Sdf

    text = scene_file(cube())
    Sdf.Layer.FindOrOpen(str(text)).Export(str(tmp_path / "scene.usdc"))
    draw = random.Random(0)
    for original in (text, tmp_path / "scene.usdc"):
        for i in range(40):
            data = bytearray(original.read_bytes())
            for _ in range(draw.choice([1, 5])):
                k = draw.randrange(len(data))
                data[k : k + draw.choice([0, 1, 9])] = draw.randbytes(draw.choice([0, 1, 9]))
            path = tmp_path / f"damaged_{i}{original.suffix}"
            path.write_bytes(data)
            try:
                Scene.from_usd(path)
            except SceneError as error:
                assert all("\n" not in fault for fault in error.faults)
        assert original.suffix == ".usdc" or capfd.readouterr() == ("", "")


# what OpenUSD opens by itself

MARK = "MARK-OF-WHAT-IS-OUTSIDE"
CLIPS = """(
    clips = {{
        dictionary default = {{
            asset[] assetPaths = [@{0}@]
            asset manifestAssetPath = @{0}@
            string primPath = "/a"
            double2[] active = [(0, 0)]
            double2[] times = [(0, 0), (1, 1)]
        }}
    }}
)"""


@pytest.fixture
def outside(tmp_path):
    """A layer outside the scenes' folder, which is no USD: whoever opens it quotes it."""
    (tmp_path / "in").mkdir()
    path = tmp_path / "outside.usda"
    path.write_text(f"#usda 1.0\n{MARK}\n")
    return path


@pytest.mark.parametrize("path", ["../outside.usda", "{0}"])
def test_value_clips_are_refused_before_they_are_opened(scene_file, outside, path):
    body = f'def Xform "Clipped" {CLIPS.format(path.format(outside))}\n{{\n}}\n'
    (fault,) = faults_of(scene_file(body, name="in/s.usda"))
    assert "</World/Clipped>: value clips" in fault and MARK not in fault


def test_validators_open_nothing_outside(scene_file, outside):
    """They would follow any attribute to a layer, and that layer's, and so on."""
    (outside.parent / "in" / "next.usda").write_text(
        '#usda 1.0\ndef "a" {\n    custom asset b = @../outside.usda@\n}\n'
    )
    body = cube(extra="custom asset more = @./next.usda@")
    path = scene_file(body, name="in/s.usda")
    found = usd.check(path)
    assert len(found) == 1 and "'../outside.usda' lies outside" in found[0]
    assert not any(MARK in fault for fault in found)


def test_an_asset_with_parts_outside_is_read_without_them(asset_here, tmp_path, capfd):
    (tmp_path / "in").mkdir()
    for suffix in (".usda", ".safetensors"):
        (tmp_path / f"cabinet{suffix}").rename(tmp_path / "in" / f"cabinet{suffix}")
    (tmp_path / "outside.usda").write_text(f"#usda 1.0\n{MARK}\n")
    path = tmp_path / "in" / "cabinet.usda"
    weights = "custom asset rfsg:neural:weights"
    more = f"custom asset more = @../outside.usda@\n    {weights}"
    path.write_text(path.read_text().replace(weights, more))
    loaded = load_asset(path)
    assert loaded.parts == () and capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "scale, words", [("1e60", "inf"), ("1e300", "scales by"), ("1e-200", "scales by")]
)
def test_sizes_that_overflow_with_their_scale(scene_file, scale, words):
    ops = f"double size = 1e300\n        double3 xformOp:scale = ({scale}, {scale}, {scale})"
    (fault,) = faults_of(scene_file(cube(ops=ops, order='"xformOp:scale"')))
    assert fault.startswith("/World/Wall: ") and words in fault


def test_a_tensor_that_declares_more_than_the_file_holds(scene_file, tmp_path, small_asset):
    data = pack(small_asset[0])
    size = int.from_bytes(data[:8], "little")
    told = json.loads(data[8 : 8 + size])
    name = next(k for k in told if k != "__metadata__")
    told[name] |= {"shape": [2**40], "data_offsets": [0, 2**42]}
    text = json.dumps(told).encode()
    (fault,) = net_faults(
        scene_file, tmp_path, len(text).to_bytes(8, "little") + text + data[8 + size :]
    )
    assert "not a safetensors file that can be read" in fault
