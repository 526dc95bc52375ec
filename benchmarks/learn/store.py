"""Results on disk: one JSON file a case and method, written beside and then renamed."""

import hashlib
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from learn.cases import Case
from learn.methods import Entry
from rfsg.learn.baselines import Readings, UnheardGatewayError
from rfsg.learn.mixture import interval_of
from rfsg.learn.protocol import Score, absolute_error, score


@dataclass(frozen=True)
class Outcome:
    """``score`` is None where the method refused (a gateway that it never heard)."""

    score: Score | None
    error_db: tuple[float, ...]
    fit_s: float
    predict_s: float


def outcome(case: Case, method: str, entry: Entry, work: Path) -> Outcome:
    """The stored result of this method, version, and data; computed and stored when there is none."""
    path = place(case, method, entry, work)
    if not path.is_file():
        write(path, json.dumps(asdict(evaluate(case, entry)), indent=1) + "\n")
    return load(path)


def stored(case: Case, method: str, entry: Entry, work: Path) -> Outcome | None:
    """The stored result, or None."""
    path = place(case, method, entry, work)
    return load(path) if path.is_file() else None


def place(case: Case, method: str, entry: Entry, work: Path) -> Path:
    """File of a result: a change of the readings, the method's code or its budget is another."""
    key = f"{fingerprint(case.train)}-{fingerprint(case.test)}-{entry.version}"
    folder = work / case.data_set / method.replace(" ", "_")
    return folder / f"{case.name}-{hashlib.sha256(key.encode()).hexdigest()[:12]}.json"


def fingerprint(readings: Readings) -> str:
    """A digest of readings, bit by bit."""
    digest = hashlib.sha256()
    for values in (readings.tx_position, readings.rx_position, readings.gateway, readings.rssi):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def evaluate(case: Case, entry: Entry) -> Outcome:
    """Fit on ``case.train``, predict and score ``case.test``; wall time of both [s]."""
    begin = time.perf_counter()
    predictor = entry.make(case).fit(case.train, case.seed)
    fitted = time.perf_counter()
    test = case.test
    try:
        said = predictor.predict(test.tx_position, test.rx_position, test.gateway)
    except UnheardGatewayError:
        return Outcome(None, (), fitted - begin, 0.0)
    spent = time.perf_counter() - fitted
    error = absolute_error(test.rssi, said.mean).round(3)
    found = score(test.rssi, said.mean, said.std, interval=interval_of(said))
    return Outcome(found, tuple(error.tolist()), fitted - begin, spent)


def load(path: Path) -> Outcome:
    found = json.loads(path.read_text())
    told = found.pop("score")
    found["error_db"] = tuple(found["error_db"])
    return Outcome(score=None if told is None else Score(**told), **found)


def write(path: Path, text: str) -> None:
    """Write beside, then rename: a killed run leaves either nothing or all of a result."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(path.name + ".part")
    beside.write_text(text)
    beside.replace(path)
