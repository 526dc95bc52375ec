"""Tables of docs/accuracy.md, one module per topic. Their truths live beside the tests that use them."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # where `tests` is found
