"""Results as xarray and pandas know them: every axis named, every number with its unit.

Both come with the extra ``notebook``: pip install rfsg[notebook].
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from rfsg.objects.plain import array
from rfsg.tracer.cells import Grid
from rfsg.tracer.pathtable import path_rows

if TYPE_CHECKING:
    from rfsg.tracer.radiomap import RadioMap
    from rfsg.tracer.simulate import Result


class MissingExtra(ImportError):
    """A library that only an extra brings is not here."""


def library(name: str) -> Any:
    """An optional library. MissingExtra says how to get it."""
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingExtra(
            f"{name} is not installed: expected the extra, pip install 'rfsg[notebook]'"
        ) from error


def paths_frame(result: "Result") -> Any:
    """pandas.DataFrame, one row per arriving path: the columns of paths.csv (``pathtable.path_rows``)."""
    return library("pandas").DataFrame(path_rows(result))


def links_frame(result: "Result") -> Any:
    """pandas.DataFrame, one row per link: the columns of links.csv (``channel.Link``)."""
    return library("pandas").DataFrame(result.links())


def channel_dataset(result: "Result") -> Any:
    """xarray.Dataset of a result.

    transfer: complex [transmitter, receiver, frequency], h(f) with antennas, 1 W in; path_gain, its
    squared size. Per path, over ``path``: gain [path, frequency] complex, delay [s], doppler [Hz],
    departure and arrival [path, axis] in the world, and which transmitter and receiver it joins.
    Paths are all those of ``result.channel``, in its order.
    """
    scene, channel = result.scene, result.channel
    names = {
        "transmitter": [radio.path for radio in scene.transmitters],
        "receiver": [radio.path for radio in scene.receivers],
    }
    link = ("transmitter", "receiver", "frequency")
    transfer = array(result.transfer())
    data = {
        "transfer": (link, transfer, _said("transfer function h(f), 1 W in", "1")),
        "path_gain": (link, np.abs(transfer) ** 2, _said("coherent path gain", "1")),
        "gain": (("path", "frequency"), array(channel.gain), _said("gain without delay", "1")),
        "delay": ("path", array(channel.delay), _said("delay", "s")),
        "doppler": ("path", array(channel.doppler), _said("Doppler shift", "Hz")),
        "departure": (("path", "axis"), array(channel.departure), _said("leaving direction", "1")),
        "arrival": (("path", "axis"), array(channel.arrival), _said("direction back", "1")),
        "path_transmitter": ("path", array(channel.tx), _said("number of the transmitter", "1")),
        "path_receiver": ("path", array(channel.rx), _said("number of the receiver", "1")),
    }
    coords: dict[str, Any] = {
        **names,
        "frequency": ("frequency", array(result.frequency), _said("frequency", "Hz")),
        "axis": ["x", "y", "z"],
    }
    return library("xarray").Dataset(data, coords, {"warnings": list(result.warnings)})


def map_dataset(found: "RadioMap") -> Any:
    """xarray.Dataset of a radio map, over [transmitter, y, x] on a plane, [transmitter, cell] on a surface.

    path_gain (linear), rss_dbm, error_db, and best_server over the cells; x and y [m] in the plane's
    own frame, and point [*cells, axis], the cells' middles in the world.
    """
    cells = found.cells
    plane = isinstance(cells, Grid)
    where = ("y", "x") if plane else ("cell",)
    each = ("transmitter", *where)
    data = {
        "path_gain": (each, array(found.path_gain), _said("power over 1 W, phases averaged", "1")),
        "rss_dbm": (each, array(found.rss_dbm()), _said("received signal strength", "dBm")),
        "error_db": (each, array(found.error_db), _said("one standard deviation", "dB")),
        "best_server": (where, array(found.best_server()), _said("strongest transmitter", "1")),
    }
    point = array(cells.point).reshape(*cells.shape, 3)
    coords: dict[str, Any] = {
        "transmitter": [radio.path for radio in found.scene.transmitters],
        "axis": ["x", "y", "z"],
        "point": ((*where, "axis"), point, _said("middle of the cell, world", "m")),
    }
    if isinstance(cells, Grid):
        coords["x"] = ("x", array(cells.x), _said("x in the plane's frame", "m"))
        coords["y"] = ("y", array(cells.y), _said("y in the plane's frame", "m"))
    attributes = {"frequency_hz": found.frequency, "method": found.method}
    return library("xarray").Dataset(data, coords, attributes)


def _said(long_name: str, units: str) -> dict[str, str]:
    return {"long_name": long_name, "units": units}
