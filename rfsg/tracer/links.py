"""Paths grouped by link: a link is one transmitter and one receiver."""

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from rfsg.tracer.records import Channel


def link_of(channel: Channel, n_rx: int) -> Int[Tensor, "p"]:
    """The number of each path's link: transmitter first, then receiver."""
    return channel.tx * n_rx + channel.rx


def summed(
    channel: Channel, value: Shaped[Tensor, "p *k"], n_tx: int, n_rx: int
) -> Shaped[Tensor, "t r *k"]:
    """Sum over the paths of each link; 0 where there are none."""
    zero = value.new_zeros(n_tx * n_rx, *value.shape[1:])
    total = zero.index_add(0, link_of(channel, n_rx), value)
    return total.reshape(n_tx, n_rx, *value.shape[1:])


def largest(
    channel: Channel, value: Float[Tensor, "p f"], n_tx: int, n_rx: int
) -> Float[Tensor, "t r f"]:
    """Largest of a value that is never negative over each link; 0 where there are no paths."""
    zero = value.new_zeros(n_tx * n_rx, value.shape[1])
    link = link_of(channel, n_rx)[:, None].expand_as(value)
    most = zero.scatter_reduce(0, link, value, "amax")
    return most.reshape(n_tx, n_rx, value.shape[1])


def strongest(
    channel: Channel, weight: Float[Tensor, "p f"], n_tx: int, n_rx: int
) -> Bool[Tensor, "p f"]:
    """Which path of each link carries most; the first of equals, and none where nothing is carried."""
    link = link_of(channel, n_rx)
    peak = largest(channel, weight, n_tx, n_rx).flatten(0, 1)
    number = torch.arange(len(weight), device=weight.device)[:, None].expand_as(weight)
    at_peak = (weight > 0) & (weight == peak[link])
    first = number.new_full(peak.shape, len(weight)).scatter_reduce(
        0, link[:, None].expand_as(weight), number.masked_fill(~at_peak, len(weight)), "amin"
    )
    return at_peak & (number == first[link])
