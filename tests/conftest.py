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
