"""What the command line prints: sentences and tables, and progress on stderr."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer


def say(sentence: str, code: int) -> int:
    for line in sentence.splitlines():
        typer.echo(f"rfsg: {line}", err=True)
    return code


def note(sentence: str) -> None:
    typer.echo(f"note: {sentence}", err=True)


def print_files(out: Path, names: tuple[str, ...]) -> None:
    for name in names:
        typer.echo(str(out / name))


def print_table(title: str, rows: list[dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for name in rows[0] if rows else ():
        table.add_column(name, no_wrap=name in ("path", "tx", "rx"))
    for row in rows:
        table.add_row(*(str(value) for value in row.values()))
    terminal = Console()
    # Piped output has no width of its own: leave lines whole, for grep and awk.
    (terminal if terminal.is_terminal else Console(width=200)).print(table, markup=False)


@contextmanager
def bar() -> Iterator[Callable[..., None]]:
    """progress(stage) or progress(stage, done, total, note): bars on stderr; quiet when piped.

    A stage without counts is over when the next one begins.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    tasks: dict[str, Any] = {}
    with Progress(*columns, console=console, disable=not console.is_terminal) as bars:

        def progress(
            stage: str, done: float | None = None, total: float | None = None, note: str = ""
        ) -> None:
            if stage not in tasks:
                _finish(bars)
                tasks[stage] = bars.add_task(stage, total=total)
            if done is not None:
                text = f"{stage}: {note}" if note else stage
                bars.update(tasks[stage], completed=done, total=total, description=text)

        yield progress
        _finish(bars)


def _finish(bars: Any) -> None:
    for task in bars.tasks:
        bars.update(task.id, completed=task.total or 1, total=task.total or 1)
