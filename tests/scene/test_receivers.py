"""Receivers as a grid and as CSV lines: places, names, every fault at once."""

import pytest
import torch

from rfsg.scene import receivers
from rfsg.scene.receivers import from_csv, grid
from rfsg.scene.scene import SceneError


def test_grid_includes_both_ends_row_by_row():
    radios = grid((1.0, 2.0), (0.3, 0.1), 0.1, 1.2)
    assert len(radios) == 4 * 2  # 0.3 / 0.1 rounds to just under 3
    assert radios[1].path == "/World/Grid/rx_0_1"
    torch.testing.assert_close(
        radios[-1].position, torch.tensor([1.3, 2.1, 1.2], dtype=torch.float64)
    )
    assert len({r.path for r in radios}) == 8


@pytest.mark.parametrize(
    "arguments",
    [
        ((0.0, 0.0), (1.0, 1.0), 0.0),
        ((0.0, 0.0), (-1.0, 1.0), 0.1),
        ((0.0, float("nan")), (1.0, 1.0), 0.1),
        ((0.0, 0.0, 0.0), (1.0, 1.0), 0.1),
        ((0.0, 0.0), (1e6, 1e6), 1e-3),
    ],
)
def test_grid_refuses_what_is_no_grid(arguments):
    with pytest.raises(SceneError, match="^grid: "):
        grid(*arguments)


def test_csv(tmp_path):
    path = tmp_path / "rx.csv"
    path.write_text(
        "name, x, y, z, yaw_deg, pattern\nhall 1, 1, 2, 3, 90, tr38901\n7,-1e-1,0,1.5,0,\n"
    )
    first, second = from_csv(path)
    assert (first.path, first.pattern) == ("/World/Receivers/hall_1", "tr38901")
    assert (second.path, second.pattern) == ("/World/Receivers/_7", "isotropic")
    assert first.position.tolist() == [1, 2, 3] and second.position.tolist() == [-0.1, 0, 1.5]
    torch.testing.assert_close(
        first.rotation[:, 0], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    )


def test_csv_names_file_line_and_column_of_every_fault(tmp_path):
    path = tmp_path / "rx.csv"
    path.write_text(
        "name,x,y,z,polarization\na,1,two,3,V\nb,1,2,nan,V\na,1,2,3,up\nc,1\n,1,2,3,V\n"
    )
    with pytest.raises(SceneError) as error:
        from_csv(path)
    assert list(error.value.faults) == [
        f"{path}:2: y: expected a finite number, got 'two'",
        f"{path}:3: z: expected a finite number, got 'nan'",
        f"{path}:4: polarization: expected one of none, V, H, +45, -45, VH, cross, got 'up'",
        f"{path}:4: name: 'a' stands twice",
        f"{path}:5: expected 5 cells, one for each column",
        f"{path}:6: name: is empty",
    ]


@pytest.mark.parametrize("text", ["", "name,x,y\n", "name,x,y,z,hight\n", "name,x,y,z,x\n"])
def test_csv_header(tmp_path, text):
    path = tmp_path / "rx.csv"
    path.write_text(text)
    with pytest.raises(SceneError, match=f"{path}:1: column"):
        from_csv(path)


def test_csv_that_cannot_be_read(tmp_path, monkeypatch):
    path = tmp_path / "rx.csv"
    with pytest.raises(SceneError, match="rx.csv"):
        from_csv(path)
    path.write_bytes(b"name,x,y,z\n\xff\xfe,1,2,3\n")
    with pytest.raises(SceneError, match="rx.csv"):
        from_csv(path)
    path.write_text("name,x,y,z\n" + "".join(f"r{i},0,0,0\n" for i in range(5)))
    monkeypatch.setattr(receivers, "MAX_RECEIVERS", 3)
    with pytest.raises(SceneError, match="more than 3 receivers"):
        from_csv(path)
