"""The one table of what happens at a vertex: for each ``Act``, a coefficient and a dyad."""

from collections.abc import Callable

from torch import Tensor

from rfsg.tracer import acting, refract, scatter, wedge
from rfsg.tracer.acting import Acting
from rfsg.tracer.records import Act

Rule = Callable[[Acting, Tensor, int], Tensor]  # (at, rows of paths, level) -> [m f] or [m f 3 3]

COEFFICIENT: dict[Act, Rule] = {
    Act.REFLECT: acting.reflection,
    Act.DIFFRACT: wedge.coefficient,
    Act.SCATTER: scatter.coefficient,
    Act.ENTER: refract.coefficient,
    Act.LEAVE: refract.coefficient,
}
DYAD: dict[Act, Rule] = {
    Act.REFLECT: acting.reflection_dyad,
    Act.DIFFRACT: wedge.dyad,
    Act.SCATTER: scatter.dyad,
    Act.ENTER: refract.dyad,
    Act.LEAVE: refract.dyad,
}
