"""Spoiled files of every kind that is read: a scene or a sentence comes of each, and nothing else."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.scene.fuzzing import Corpus, outcomes

FEW, MANY, WORKERS = 60, 2000, 2


def amiss(told: list[dict]) -> list[dict]:
    """Those of which something else came: a crash, a hang, another error, a file that was opened."""
    return [t for t in told if t["outcome"] not in ("read", "refused") or t["opened"]]


def test_sixty_spoiled_files(tmp_path):
    told = list(outcomes(range(FEW), tmp_path))
    assert amiss(told) == []
    assert {t["outcome"] for t in told} == {"read", "refused"} and len(told) == FEW


@pytest.mark.slow
def test_two_thousand_spoiled_files(tmp_path):
    def some(worker: int) -> list[dict]:
        return list(outcomes(range(worker, MANY, WORKERS), tmp_path / str(worker)))

    with ThreadPoolExecutor(WORKERS) as pool:
        told = [t for some_of_them in pool.map(some, range(WORKERS)) for t in some_of_them]
    assert amiss(told) == []
    assert len(told) == MANY


def test_the_instrument(tmp_path):
    """Undamaged files are read, canaries are there and links lead to them, every kind has its turn."""
    kinds = len(Corpus(tmp_path).kinds)
    assert (tmp_path / "in" / "link.usda").read_bytes() == (tmp_path / "canary.usda").read_bytes()
    told = list(outcomes(range(-2 * kinds, 0), tmp_path))
    assert [t for t in told if t["outcome"] != "read" or t["opened"]] == []
    assert len({t["kind"] for t in told}) == kinds <= FEW
    assert amiss(
        [{"outcome": "read", "opened": ["/etc/passwd"]}, {"outcome": "read", "opened": []}]
    )
