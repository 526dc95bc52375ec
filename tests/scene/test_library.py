"""Libraries: what is in the folder, an index that nobody has to trust, and names that scenes take."""

import json
from dataclasses import asdict
from pathlib import Path

import pytest

from rfsg.assets import contact_sheet, rows
from rfsg.objects.body import Body
from rfsg.objects.shapes.analytic import Box, Sphere
from rfsg.objects.surfaces.interface import Conductor
from rfsg.objects.surfaces.stochastic import StochasticSurface
from rfsg.scene import library as module
from rfsg.scene.assets import load_asset, save_asset
from rfsg.scene.export import export
from rfsg.scene.library import INDEX, MAX_INDEX_BYTES, Library, error_of
from rfsg.scene.pose import Pose
from rfsg.scene.scene import Node, Scene, SceneError
from rfsg.scene.weights import same_bits

PNG = b"\x89PNG\r\n\x1a\n" + bytes(40)
OBJECTS = Path(__file__).resolve().parents[2] / "assets" / "objects"


def put(folder: Path, name: str, body: Body | None = None, **options) -> Path:
    (folder / name).mkdir(parents=True)
    body = body or Body(Box((0.2, 0.3, 0.4)), Conductor())
    return save_asset(folder / name / name.split("/")[-1], body, **options)


@pytest.fixture
def folder(tmp_path):
    """A library of a box with a picture, a fitted ball in a package, and a broken asset."""
    folder = tmp_path / "lib"
    put(folder, "box", picture=PNG)
    told = {"train": {"readings": 9, "median_db": 1.5}, "validation": {"readings": 0}}
    ball = Body(Sphere(0.3), StochasticSurface(), band=(2.4e9, 2.5e9))
    scene = Scene((Node("/Ball", ball, Pose.identity()),))
    export(scene, "/Ball", folder / "ball.usdz", picture=PNG, provenance=told)
    broken = put(folder, "broken")
    broken.with_suffix(".safetensors").write_bytes(b"no weights")
    return folder


@pytest.fixture
def reads(monkeypatch) -> list[str]:
    """The assets that are read in full, as they are."""
    names: list[str] = []

    def counted(path):
        names.append(Path(path).name)
        return load_asset(path)

    monkeypatch.setattr(module, "load_asset", counted)
    return names


def test_what_is_known_of_each(folder):
    library = Library(folder)
    assert list(library) == ["ball", "box"] and len(library) == 2
    ball, box = library.cards
    assert library["box"] == folder / "box" / "box.usda" and "desk" not in library
    assert (box.shape, box.surface, box.band, box.error) == ("box", "conductor", None, "")
    assert box.size == (0.4, 0.6, 0.8) and box.picture == "box/box.png"
    assert box.bytes == sum(f.stat().st_size for f in (folder / "box").iterdir())
    assert box.sha256 == load_asset(library["box"]).sha256
    assert (ball.surface, ball.band) == ("stochastic", (2.4e9, 2.5e9))
    assert ball.error == "power 1.5 dB (median of 9 readings)"
    assert ball.picture == "ball.usdz[ball.png]"
    assert library.picture("ball") == library.picture("box") == PNG
    (fault,) = library.faults
    assert "/broken" in fault and "hash" in fault


def test_an_asset_goes_into_a_scene_by_its_name(folder):
    library = Library(folder)
    scene = Scene((Node("/World/It", Body(Sphere(9.0), Conductor()), Pose.at(1, 2, 3)),))
    for name in library:
        body = scene.replaced("/World/It", library[name]).node("/World/It").body
        assert same_bits(body.shape, load_asset(library[name]).body.shape)


def test_a_name_that_is_not_there_says_what_is(folder):
    with pytest.raises(KeyError, match="desk: not in .*lib, which holds ball, box"):
        Library(folder)["desk"]


def test_two_of_one_name_are_called_by_their_folders(tmp_path):
    for where in ("old", "new"):
        (tmp_path / where).mkdir()
        save_asset(tmp_path / where / "desk", Body(Box((1.0, 1.0, 1.0)), Conductor()))
    put(tmp_path, "chair")
    assert list(Library(tmp_path)) == ["chair", "new/desk", "old/desk"]


def test_the_index_is_kept_and_written_anew_where_a_file_changed(folder, reads):
    first = Library(folder)
    assert sorted(reads) == ["ball.usdz", "box.usda", "broken.usda"]
    before, told = (folder / INDEX).read_bytes(), list(reads)
    assert Library(folder).cards == first.cards
    assert reads[len(told) :] == ["broken.usda"]  # what the index knows is not read again
    assert (folder / INDEX).read_bytes() == before
    save_asset(folder / "box" / "box", Body(Sphere(1.0), Conductor()), overwrite=True)
    assert Library(folder).card("box").shape == "sphere"
    assert (folder / INDEX).read_bytes() != before
    (folder / "ball.usdz").unlink()
    assert list(Library(folder)) == ["box"]
    assert [row["name"] for row in json.loads((folder / INDEX).read_text())["assets"]] == ["box"]
    assert not list(folder.rglob("*.part"))


def test_a_folder_that_may_only_be_read_has_no_index(folder, monkeypatch):
    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(module, "write_beside", refuse)
    assert list(Library(folder)) == ["ball", "box"] and not (folder / INDEX).exists()


HOSTILE = {
    "junk": b"\xff\xfe{",
    "nested": b"[" * 100_000,
    "too large": b" " * (MAX_INDEX_BYTES + 1),
    "a list": b"[1, 2]",
    "another version": b'{"formatVersion": 9, "assets": []}',
    "a number": b'{"formatVersion": 1, "assets": 7}',
    "odd rows": b'{"formatVersion": 1, "assets": [3, null, {"name": "x"}]}',
}


@pytest.mark.parametrize("data", HOSTILE.values(), ids=HOSTILE)
def test_an_index_that_is_damaged_is_as_good_as_none(folder, data):
    expected = Library(folder).cards
    (folder / INDEX).write_bytes(data)
    assert Library(folder).cards == expected
    assert len(json.loads((folder / INDEX).read_text())["assets"]) == 2


@pytest.mark.parametrize(
    "change",
    [
        {"name": 7}, {"error": "x" * 5000}, {"size": [1, 2]}, {"size": [1, 2, "3"]},
        {"band": [1e400, 2]}, {"band": [1]}, {"bytes": None}, {"bytes": True}, {"picture": []},
    ],
    ids=str,
)  # fmt: skip
def test_an_entry_out_of_order_spoils_the_index_and_nothing_else(folder, change):
    expected = Library(folder).cards
    told = [asdict(card) for card in expected]
    text = json.dumps({"formatVersion": 1, "assets": [told[0] | change, told[1]]})
    (folder / INDEX).write_text(text)
    assert Library(folder).cards == expected


def test_an_index_names_no_file_outside(folder, tmp_path):
    """What an entry calls its file or its picture opens nothing that is not in the folder."""
    (tmp_path / "secret.png").write_bytes(PNG)
    (tmp_path / "secret.usda").write_bytes((folder / "box" / "box.usda").read_bytes())
    rows = [asdict(card) for card in Library(folder).cards]
    rows[1] |= {"picture": "../secret.png"}
    rows.append(rows[1] | {"name": "secret", "file": "../secret.usda"})
    (folder / INDEX).write_text(json.dumps({"formatVersion": 1, "assets": rows}))
    library = Library(folder)
    assert list(library) == ["ball", "box"] and library.picture("box") is None


def test_links_out_of_the_folder_are_not_followed(folder, tmp_path):
    put(tmp_path, "other")
    (folder / "other").symlink_to(tmp_path / "other")
    (folder / "one.usda").symlink_to(tmp_path / "other" / "other.usda")
    assert list(Library(folder)) == ["ball", "box"]


def test_too_many_files_and_no_folder_are_refused(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MAX_ASSETS", 2)
    with pytest.raises(SceneError, match="more than 2 USD files"):
        Library(folder)
    with pytest.raises(SceneError, match="no such folder"):
        Library(tmp_path / "nowhere")


def test_an_empty_folder_is_an_empty_library_without_index(tmp_path):
    assert list(Library(tmp_path)) == [] and list(tmp_path.iterdir()) == []


def test_add_copies_the_files_whole(folder, tmp_path):
    desk = put(tmp_path / "elsewhere", "desk", picture=PNG)
    library = Library(folder).add(desk)
    assert list(library) == ["ball", "box", "desk"]
    for file in desk.parent.iterdir():
        assert (folder / "desk" / file.name).read_bytes() == file.read_bytes()
    with pytest.raises(SceneError, match="already exists"):
        library.add(desk)
    assert list(library.add(desk, overwrite=True)) == list(library)
    package = library.add(library["ball"])["ball/ball"]
    assert package.read_bytes() == (folder / "ball.usdz").read_bytes()


def test_add_refuses_what_a_copy_would_tear(folder, tmp_path):
    desk = put(tmp_path / "elsewhere", "desk")
    (desk.parent.parent / "rfsg-assets.toml").touch()
    desk.write_text(desk.read_text().replace("@./", "@../"))
    weights = desk.with_suffix(".safetensors")
    weights.rename(desk.parent.parent / weights.name)
    with pytest.raises(SceneError, match="several folders.*rfsg export"):
        Library(folder).add(desk)
    assert not (folder / "desk").exists()


def test_the_page_holds_everything_and_no_markup_of_strangers(folder):
    put(folder, "<b onload=x>&", picture=b"<svg onload=alert(1)>")
    page = contact_sheet(Library(folder))
    assert page.count("<figure>") == 3 and page.count('<img alt="') == 2
    assert "data:image/png;base64," in page and "svg" not in page
    assert "&lt;b onload=x&gt;&amp;" in page and "<b onload" not in page
    assert "2.4 to 2.5 GHz" in page and "0.4 × 0.6 × 0.8 m" in page


def test_rows_say_what_is_not_told(folder):
    ball, box = rows(Library(folder))
    assert (ball["band"], box["band"]) == ("2.4 to 2.5 GHz", "any")
    assert (ball["error"], box["error"]) == ("power 1.5 dB (median of 9 readings)", "not told")
    assert box["picture"] == str(folder / "box" / "box.png")


@pytest.mark.parametrize(
    "story", [{"report": 3}, {"report": {"surface_mean_mm": None}}, {}, {"train": []}]
)
def test_a_story_of_other_kinds_tells_no_error(story):
    assert error_of(story) == ""


def test_the_shipped_objects_are_a_library_whose_index_is_up_to_date():
    told = json.loads((OBJECTS / INDEX).read_text())["assets"]  # a stale one would be written anew
    library = Library(OBJECTS)
    assert list(library) == ["cabinet", "chair", "desk", "person"] and library.faults == ()
    assert all((library.picture(name) or b"").startswith(PNG[:8]) for name in library)
    assert told == [json.loads(json.dumps(asdict(card))) for card in library.cards]
