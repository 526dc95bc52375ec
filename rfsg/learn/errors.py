"""What stops a learning run; every message says what was given, what was expected, and what to try."""


class LearnError(RuntimeError):
    """A training that cannot begin, go on or be used."""


class SelectionError(LearnError):
    """A pattern that names nothing that can be learned."""


class MeasurementError(ValueError):
    """Measurements that cannot be used; ``faults`` lists all of them."""

    def __init__(self, faults: list[str]):
        self.faults = list(faults)
        shown = self.faults[:SHOWN]
        more = len(self.faults) - len(shown)
        super().__init__("\n".join(shown + [f"... and {more} more"] * (more > 0)))


SHOWN = 20  # faults in one message; a file with a wrong column has as many as lines
