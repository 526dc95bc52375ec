"""Fixed seeds for every test, and no silent skips: see expected_skips.txt."""

from fnmatch import fnmatchcase
from pathlib import Path

import pytest

EXPECTED_SKIPS = Path(__file__).with_name("expected_skips.txt")


def pytest_addoption(parser):
    parser.addoption(
        "--strict-skips",
        action="store_true",
        help="fail on a skipped test that tests/expected_skips.txt does not name",
    )


def expected_skips() -> list[str]:
    lines = (line.strip() for line in EXPECTED_SKIPS.read_text().splitlines())
    return [line.split()[0] for line in lines if line and not line.startswith("#")]


def refuse_unexpected_skip(report, config) -> None:
    """Turn a skip that nobody announced into a failure, in place."""
    if not report.skipped or hasattr(report, "wasxfail") or not config.getoption("strict_skips"):
        return
    if any(fnmatchcase(report.nodeid, pattern) for pattern in expected_skips()):
        return
    reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    report.outcome = "failed"
    report.longrepr = f"{reason}\n{report.nodeid} is not in {EXPECTED_SKIPS.name}"


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(item):
    report = yield
    refuse_unexpected_skip(report, item.config)
    return report


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_make_collect_report(collector):
    report = yield
    refuse_unexpected_skip(report, collector.config)
    return report


@pytest.fixture(autouse=True)
def same_seed_every_time():
    import torch

    torch.manual_seed(0)


@pytest.fixture
def small_run():
    """A result made by hand: one box, one sphere, one transmitter, two receivers.

    Link 0 has line of sight and a reflection from the box; link 1 goes through the sphere; one more
    path is blocked. Everything that draws or writes a result can be tried on it, without a tracer.
    """
    import torch

    from rfsg.objects.body import Body
    from rfsg.objects.shapes.analytic import Box, Sphere
    from rfsg.objects.surfaces.interface import Conductor
    from rfsg.scene.pose import Pose
    from rfsg.scene.radios import Radio
    from rfsg.scene.scene import Node, Scene
    from rfsg.tracer.launch import SearchReport
    from rfsg.tracer.plan import Plan, Quality
    from rfsg.tracer.records import Chains, Channel, Paths
    from rfsg.tracer.simulate import Result

    def real(values):
        return torch.tensor(values, dtype=torch.float64)

    scene = Scene(
        nodes=(
            Node("/World/Wall", Body(Box((2.0, 0.1, 1.5)), Conductor()), Pose.at(2.0, 3.0, 1.5)),
            Node("/World/Ball", Body(Sphere(0.3), Conductor()), Pose.at(2.0, -1.0, 1.0)),
        ),
        transmitters=(Radio.at("/World/AP", 0.0, 0.0, 1.0, power_dbm=10.0),),
        receivers=(Radio.at("/World/rx_0", 4.0, 0.0, 1.0), Radio.at("/World/rx_1", 4.0, -2.0, 1.0)),
        frequency=1e9,
    )
    tx, bounce = real([0.0, 0, 1]), real([2.0, 2.9, 1])
    ends = [real([4.0, 0, 1]), real([4.0, 0, 1]), real([4.0, -2, 1]), real([4.0, -2, 1])]
    rows = [[tx, r, r] for r in ends]
    rows[1] = [tx, bounce, ends[1]]
    vertices = torch.stack([torch.stack(row) for row in rows])
    length = vertices.diff(dim=1).norm(dim=-1).sum(dim=1)
    which = torch.tensor([[-1], [0], [-1], [-1]])
    towards = vertices[:, 1] - vertices[:, 0]
    back = vertices[torch.arange(4), torch.tensor([0, 1, 0, 0])] - torch.stack(ends)
    paths = Paths(
        tx=torch.zeros(4, dtype=torch.int64),
        rx=torch.tensor([0, 0, 1, 1]),
        which=which,
        act=torch.zeros_like(which),
        item=which,
        vertices=vertices,
        normal=torch.zeros(4, 1, 3, dtype=torch.float64),
        length=length,
        spread=1 / length,
        caustics=torch.zeros(4, dtype=torch.int64),
        status=torch.zeros(4, dtype=torch.int64),
    )
    gain = torch.polar(0.0239 / length, real([0.0, 3.0, 0.5, 0.0]))[:, None]
    channel = Channel(
        tx=paths.tx,
        rx=paths.rx,
        frequency=real([1e9]),
        delay=length / 299_792_458.0,
        gain=gain,
        doppler=real([0.0, 1.5, 0.0, 0.0]),
        departure=towards / towards.norm(dim=-1, keepdim=True),
        arrival=back / back.norm(dim=-1, keepdim=True),
        crossed=torch.tensor([[2, 1, 0], [3, 1, 0]]),
        blocked=torch.tensor([False, False, False, True]),
    )
    none = torch.zeros(0, dtype=torch.int64)
    chains = Chains(none, none, none.reshape(0, 1), none.reshape(0, 1), real([]).reshape(0, 1, 3))
    return Result(
        scene,
        channel.frequency,
        paths,
        channel,
        chains,
        Plan(Quality(), ("reflection",), ("diffraction: no edges asked for",)),
        SearchReport(rays=100),
        status_counts={"OK": 3, "OPAQUE": 1},
        seconds={"search": 0.1, "solve": 0.2},
        warnings=("a warning",),
    )
