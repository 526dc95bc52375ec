"""What is baked of a shape holds for it, and files of it are trusted no further than they prove."""

import json
import warnings
from collections import OrderedDict

import pytest
import torch
import trimesh
from safetensors.torch import load, save

from rfsg.objects.shapes import kept
from rfsg.objects.shapes.baked import bake, key_of
from rfsg.objects.shapes.band import LEAST_TURN, WAYS
from rfsg.objects.shapes.blocks import BEND_SAFETY, ROUNDING
from rfsg.objects.shapes.neural import NeuralShape
from rfsg.objects.shapes.offs import TOLERANCE
from rfsg.objects.shapes.refined import refined
from rfsg.objects.shapes.shell import MOVED, SAFETY
from tests.tracer.shapes import Field, ball, two_walls

STEP = 0.02


def small(seed=0):
    return NeuralShape(
        [[-0.3] * 3, [0.3] * 3], width=16, depth=3, skip=1, lipschitz=2.0, seed=seed
    ).requires_grad_(False)


def inside(shape, count, seed=0):
    low, high = shape.bounds().float()
    generator = torch.Generator().manual_seed(seed)
    return low + (high - low) * torch.rand(count, 3, generator=generator)


@pytest.fixture(autouse=True)
def nothing_kept(monkeypatch):
    monkeypatch.setattr(kept, "_MEMORY", OrderedDict())


@pytest.mark.parametrize("shape", [small(), Field(ball(0.3), [0.4] * 3, lipschitz=1.0)])
def test_values_err_by_no_more_than_their_doubt(shape):
    made = bake(shape, STEP)
    point = inside(shape, 20_000)
    value, doubt = made.look(point)
    assert bool(((shape.sdf(point) - value).abs() <= doubt + 2e-6).all())


def test_a_shell_holds_what_a_grid_steps_over():
    """Two plates of 12 mm on a grid of 20 mm: every point of them is within the shell."""
    shape = Field(two_walls(0.2, 0.012), [0.3, 0.3, 0.3], lipschitz=1.0)
    for shift in (0.0, 0.003, 0.006, 0.009):
        moved = Field(lambda p, s=shift: shape.f(p - p.new_tensor([s, 0.0, 0.0])), [0.3] * 3, 1.0)
        try:
            made = bake(moved, STEP)
        except ValueError:
            continue  # nothing on the grid: such a shape is never baked, and the plain march is used
        shell = trimesh.Trimesh(made.shell.vertices.numpy(), made.shell.triangles.numpy())
        assert shell.is_watertight
        sheet = inside(moved, 400)
        sheet[:, 0] = torch.where(sheet[:, 0] > 0, 0.106, -0.106) + shift
        assert bool(shell.contains(sheet.numpy()).all())


def test_zero_mesh_is_closed_and_split_until_it_follows_the_surface():
    shape = Field(ball(0.3), [0.4] * 3, lipschitz=1.0)
    made = bake(shape, 0.04)
    mesh = trimesh.Trimesh(made.zero.vertices.numpy(), made.zero.triangles.numpy(), process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    ends = made.zero.vertices[torch.tensor(mesh.edges_unique)]
    # of a chord of length c the middle is c^2 / 8 R below a sphere
    assert float(shape.sdf(ends.mean(1)).abs().max()) < 1e-4
    coarse = refined(shape, made.zero.vertices, made.zero.triangles, 0.04, 5e-5, 0)
    assert len(coarse[1]) == len(made.zero.triangles)


def test_key_follows_weights_and_settings():
    shape = small()
    keys = {
        key_of(shape, STEP),
        key_of(small(), STEP),
        key_of(shape, 2 * STEP),
        key_of(small(1), STEP),
    }
    assert len(keys) == 3
    before = key_of(shape, STEP)
    shape.to_value.bias.add_(1e-6)
    assert key_of(shape, STEP) != before


def test_memory_forgets_a_shape_that_changed():
    shape = small()
    first = kept.baked(shape, step=STEP)
    assert kept.baked(shape, step=STEP) is first
    shape.to_value.bias.add_(1e-3)
    assert kept.baked(shape, step=STEP).key != first.key


def test_a_file_comes_back_as_it_was(tmp_path, monkeypatch):
    shape = small()
    first = kept.baked(shape, tmp_path, STEP)
    assert [f.name for f in tmp_path.iterdir()] == [f"{first.key[:32]}.baked.safetensors"]
    kept._MEMORY.clear()
    monkeypatch.setattr(kept, "bake", lambda *_: pytest.fail("baked again"))
    again = kept.baked(shape, tmp_path, STEP)
    point = inside(shape, 1000)
    assert all(torch.equal(a, b) for a, b in zip(first.look(point), again.look(point), strict=True))
    assert torch.equal(first.zero.triangles, again.zero.triangles)
    assert (first.margin, first.slope, first.offs) == (again.margin, again.slope, again.offs)


def test_a_folder_that_may_only_be_read_is_no_fault(tmp_path, monkeypatch):
    def refuse(*_):
        raise PermissionError("read-only")

    monkeypatch.setattr("pathlib.Path.write_bytes", refuse)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(kept.baked(small(), tmp_path, STEP).zero.triangles) > 100
    assert not list(tmp_path.iterdir())


def _beyond(tensors, head):
    tensors["block"] = tensors["block"] + 10_000


def _no_corner(tensors, head):
    tensors["zero.triangles"] = tensors["zero.triangles"] - 5


def _not_a_number(tensors, head):
    tensors["values"][0, 0] = torch.nan


def _another(tensors, head):
    head["key"] = "0" * 64


def _fewer(tensors, head):
    del tensors["error"]


def _wide(tensors, head):
    tensors["error"] = tensors["error"].double()


def _short(tensors, head):
    tensors["gradient"] = tensors["gradient"][:-1]


def _endless(tensors, head):
    head["slope"] = -1.0


def _exact(tensors, head):
    head["offs"]["mesh"]["usual"] = -1.0


def _wayless(tensors, head):
    del head["offs"]["newton"]


SPOILED = [
    _beyond,
    _no_corner,
    _not_a_number,
    _another,
    _fewer,
    _wide,
    _short,
    _endless,
    _exact,
    _wayless,
]


@pytest.mark.parametrize("spoil", SPOILED, ids=[f.__name__ for f in SPOILED])
def test_a_spoiled_file_is_ignored_with_a_warning(spoil, tmp_path):
    shape = small()
    first = kept.baked(shape, tmp_path, STEP)
    (path,) = tmp_path.iterdir()
    data = path.read_bytes()
    head = kept._head(data)
    tensors = {name: tensor.clone() for name, tensor in load(data).items()}
    spoil(tensors, head)
    path.write_bytes(
        save({k: v.contiguous() for k, v in tensors.items()}, {"rfsg-baked": json.dumps(head)})
    )
    kept._MEMORY.clear()
    with pytest.warns(UserWarning, match="ignored, the shape is baked again"):
        again = kept.baked(shape, tmp_path, STEP)
    assert torch.equal(first.values, again.values)


@pytest.mark.parametrize("content", [b"", b"x" * 7, b"\xff" * 64, b"\x02" + 7 * b"\0" + b"[]"])
def test_what_is_no_safetensors_file_is_ignored(content, tmp_path):
    shape = small()
    (tmp_path / f"{key_of(shape, STEP)[:32]}{kept.ENDING}").write_bytes(content)
    with pytest.warns(UserWarning, match="ignored"):
        assert len(kept.baked(shape, tmp_path, STEP).values)


def test_a_file_too_large_is_not_read(tmp_path, monkeypatch):
    shape = small()
    kept.baked(shape, tmp_path, STEP)
    kept._MEMORY.clear()
    monkeypatch.setattr(kept, "MAX_BYTES", 100)
    with pytest.warns(UserWarning, match="the limit is 100"):
        kept.baked(shape, tmp_path, STEP)


def crease(p):
    x, y, z = p.unbind(-1)
    return torch.minimum(p.norm(dim=-1) - 0.2, (x - 0.1).abs() + 0.5 * y * z / 0.3 - 0.02)


FIELDS = {"ball": ball(0.3), "crease": crease}


@pytest.mark.parametrize("kind", FIELDS)
def test_a_shell_holds_all_and_keeps_close(kind):
    """Whatever is within f = 0 is within the shell, at creases too; on a sphere it is as near as the
    bend of f over a cell leaves it: an eighth of it along each axis, with the margins taken."""
    shape = Field(FIELDS[kind], [0.4] * 3, lipschitz=2.0)
    made = bake(shape, 0.01)
    shell = trimesh.Trimesh(made.shell.vertices.numpy(), made.shell.triangles.numpy())
    assert shell.is_watertight
    some = torch.randint(len(made.zero.vertices), (6000,))
    point = made.zero.vertices[some] + 0.002 * torch.randn(len(some), 3)
    within = point[(shape.sdf(point) < 0) & (point.abs().amax(-1) < 0.39)]
    assert len(within) > 300 and bool(shell.contains(within.numpy()).all())
    if kind == "ball":
        # second differences add up to 2 h^2 / R, mixed ones to half of h^2 / R
        bend, twist = 2.0 * 0.01**2 / 0.28, 0.5 * 0.01**2 / 0.28
        allowed = SAFETY * BEND_SAFETY * bend / 8.0 + twist + made.slope * 2 * MOVED * 0.01
        assert float(shape.sdf(made.shell.vertices).max()) < allowed + bend / 8.0


@pytest.mark.parametrize("kind", FIELDS)
def test_slopes_turn_by_no_more_than_is_said(kind):
    """Along lines of up to a cell's length from the surface, whichever way they go."""
    shape = Field(FIELDS[kind], [0.4] * 3, lipschitz=2.0)
    made = bake(shape, 0.01)
    generator = torch.Generator().manual_seed(8)
    some = torch.randint(len(made.zero.vertices), (20_000,), generator=generator)
    start = made.zero.vertices[some].clamp(-0.38, 0.38)
    direction = torch.nn.functional.normalize(torch.randn(20_000, 3, generator=generator), dim=-1)
    length = torch.rand(20_000, generator=generator)
    ends = [start, start + made.step * length[:, None] * direction]
    slopes = [(shape.value_and_gradient(p)[1] * direction).sum(-1) for p in ends]
    allowed = made.look_about(start)[2] * length.clamp(min=LEAST_TURN)
    assert bool(((slopes[1] - slopes[0]).abs() <= allowed).all())


def test_offs_hold_on_a_sphere():
    """A mesh errs by its chords' sagitta, values by the bend of f; both are found, and nothing is lost."""
    radius, step = 0.3, 0.02
    offs = bake(Field(ball(radius), [0.4] * 3, lipschitz=1.0), step).offs
    assert set(offs) == set(WAYS)
    # a triangle of sides no longer than sqrt(3) h lies no deeper than that of a circle through its corners
    assert 0.0 < offs["mesh"].usual <= offs["mesh"].most <= SAFETY * step**2 / (2 * radius) + 1e-5
    assert offs["newton"].most <= offs["mesh"].most
    # each axis' second derivative is at most 1 / R, and all three add up to 2 / R
    assert 0.0 < offs["grid"].usual <= step**2 / 8.0 * 2.0 / (radius - step)
    assert offs["certain"].most <= SAFETY * (TOLERANCE + ROUNDING) * (1.0 + 1e-3)
    assert all(off.lost < 1e-3 for off in offs.values())


def test_offs_are_known_of_what_is_kept(tmp_path, monkeypatch):
    """In memory, or in a file of which only the head is read; of nothing else."""
    monkeypatch.setattr("rfsg.objects.shapes.baked.default_step", lambda shape: STEP)
    shape = small()
    shape.folder = str(tmp_path)
    assert kept.offs_of(shape) is None
    made = kept.baked(shape, tmp_path, STEP)
    assert kept.offs_of(shape) == made.offs
    kept._MEMORY.clear()
    monkeypatch.setattr(kept, "load", lambda _: pytest.fail("read as a whole"))
    assert kept.offs_of(shape) == made.offs
    shape.to_value.bias.add_(1e-3)
    assert kept.offs_of(shape) is None


def test_memory_forgets_what_was_asked_longest_ago(monkeypatch):
    monkeypatch.setattr(kept, "MOST_KEPT", 2)
    monkeypatch.setattr(kept, "bake", lambda shape, step: bake(shape, 0.05))
    one, two, three = (small(seed) for seed in (1, 2, 3))
    first = kept.baked(one, step=0.05)
    kept.baked(two, step=0.05)
    assert kept.baked(one, step=0.05) is first
    kept.baked(three, step=0.05)
    assert list(kept._MEMORY) == [id(one), id(three)]


@pytest.mark.parametrize("kind", ["ball", "crease"])
def test_f_keeps_its_sign_as_far_ahead_as_is_said(kind):
    """Sampled densely all along: in a smooth field, and across creases and saddles of one."""
    shape = Field(FIELDS[kind], [0.4] * 3, lipschitz=2.0)
    made = bake(shape, 0.01)
    generator = torch.Generator().manual_seed(0)
    some = torch.randint(len(made.zero.vertices), (20_000,), generator=generator)
    point = made.zero.vertices[some] + 0.01 * torch.randn(20_000, 3, generator=generator)
    point = point.clamp(-0.38, 0.38)
    direction = torch.nn.functional.normalize(torch.randn(20_000, 3, generator=generator), dim=-1)
    value, doubt, way = made.look_ahead(point, direction)
    assert torch.equal(value, made.look(point)[0]) and torch.equal(doubt, made.look(point)[1])
    on = torch.nonzero(way > 0).squeeze(-1)
    assert len(on) > 5000 and float(way.max()) <= 3**0.5 * made.step + 2e-6
    t = way[on, None] * torch.linspace(0.0, 1.0, 50)
    f = shape.sdf((point[on, None] + t[..., None] * direction[on, None]).double())
    assert bool(((f < 0) == (value[on, None] < 0)).all())
