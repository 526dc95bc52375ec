"""A bounded cache that forgets what was asked for longest ago."""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Value = TypeVar("Value")


class Recent(Generic[Value]):
    """At most ``most`` values by key, each made in one state: asked for in another, it is made anew.

    ``functools.lru_cache`` with a state beside the key. An object that changes in place is a key by its
    id; its state says what its parameters are now and holds the object, so that the id is no other's.
    """

    def __init__(self, most: int):
        self.most = most
        self._kept: OrderedDict[Hashable, tuple[object, Value]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, key: Hashable, state: object, make: Callable[[], Value]) -> Value:
        """The value of a key in a state: the one that is kept, or what ``make`` makes of it."""
        kept = self._kept.get(key)
        if kept is None or kept[0] != state:
            kept = self._kept[key] = (state, make())
        self._kept.move_to_end(key)
        while len(self._kept) > self.most:
            self._kept.popitem(last=False)
        return kept[1]
