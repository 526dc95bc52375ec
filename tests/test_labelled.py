"""Results as labelled arrays and tables: the same numbers, every axis named."""

from importlib import import_module

import numpy as np
import pytest
import torch

import rfsg
from rfsg.tracer.labelled import MissingExtra

TX = rfsg.Radio.at("/World/tx", 0.0, 0.0, 1.5, power_dbm=10.0)
RX = (rfsg.Radio.at("/World/rx_0", 4.0, 0.0, 1.5), rfsg.Radio.at("/World/rx_1", 0.0, 7.0, 1.0))
FREQUENCY = torch.tensor([2.4e9, 2.5e9])


@pytest.fixture(scope="module")
def free_space():
    return rfsg.simulate(rfsg.Scene(transmitters=(TX,), receivers=RX), FREQUENCY)


def test_the_transfer_function_keeps_its_values_and_gains_names(free_space):
    found = free_space.to_xarray()
    assert found["transfer"].dims == ("transmitter", "receiver", "frequency")
    np.testing.assert_array_equal(found["transfer"].values, free_space.transfer().numpy())
    asked = found["transfer"].sel(receiver="/World/rx_1", frequency=2.5e9).item()
    assert asked == complex(free_space.transfer()[0, 1, 1])
    assert found["delay"].attrs["units"] == "s"
    np.testing.assert_array_equal(found["delay"].values, free_space.channel.delay.numpy())


def test_a_table_has_a_row_for_each_path_and_each_link(free_space):
    paths, links = free_space.to_pandas(), free_space.to_pandas("links")
    assert len(paths) == len(links) == 2
    distance = torch.stack([r.position for r in RX]).sub(TX.position).norm(dim=1).numpy()
    np.testing.assert_allclose(paths["delay_ns"], 1e9 * distance / 299_792_458.0, rtol=1e-12)
    assert list(links["rx"]) == [r.path for r in RX]


def test_another_word_for_a_table_is_refused(free_space):
    with pytest.raises(ValueError, match="'link': expected one of paths, links"):
        free_space.to_pandas("link")


def test_a_map_keeps_its_values_and_places(small_run):
    scene = small_run.scene
    found = rfsg.radio_map(scene, 2.44e9, height=1.0, cell=1.0, quality="draft")
    labelled = found.to_xarray()
    assert labelled["path_gain"].dims == ("transmitter", "y", "x")
    np.testing.assert_array_equal(labelled["rss_dbm"].values, found.rss_dbm().numpy())
    place = labelled["point"].values.reshape(-1, 3)
    np.testing.assert_array_equal(place, found.cells.point.numpy())
    table = found.to_pandas()
    assert np.isclose(table["path_gain"].sum(), 3 * float(found.path_gain.sum()))  # x, y, z each


def test_a_library_that_is_not_there_is_named_with_what_brings_it(free_space, monkeypatch):
    def without_pandas(name):
        if name == "pandas":
            raise ImportError("no pandas")
        return import_module(name)

    monkeypatch.setattr("rfsg.tracer.labelled.import_module", without_pandas)
    with pytest.raises(MissingExtra, match=r"rfsg\[notebook\]"):
        free_space.to_pandas()
