"""What went wrong, as a sentence and an exit code."""

INTERNAL, USAGE, INPUT, NUMERIC, INTERRUPTED = 1, 2, 3, 4, 130
_NUMERIC_FAULTS = ("LinAlgError", "OutOfMemoryError")  # torch's, by name: torch may not be loaded


def verdict(error: Exception) -> tuple[str, int]:
    """What to say about an exception, and the exit code."""
    from rfsg.report import OutputExists

    if hasattr(error, "format_message"):  # what typer raises for a command line it cannot read
        words = error.format_message()  # type: ignore[attr-defined]
        return words and f"{words} (rfsg --help tells more)", USAGE
    if isinstance(error, OutputExists):
        return str(error), USAGE
    if isinstance(error, OSError):
        return f"{error.filename or ''}: {error.strerror or error}".lstrip(": "), INPUT
    kind = type(error).__name__
    if isinstance(error, ArithmeticError | MemoryError) or kind in _NUMERIC_FAULTS:
        return f"numeric problem: {error or kind}; --set chunk=4096 needs less memory", NUMERIC
    if kind == "LearnError":  # a training that ended in something unusable
        return str(error), NUMERIC
    if isinstance(error, ValueError) or kind.endswith("Error") and _is_ours(error):
        return str(error), INPUT
    return f"rfsg itself failed ({kind}: {error}); --debug shows where", INTERNAL


def _is_ours(error: Exception) -> bool:
    return type(error).__module__.split(".")[0] == "rfsg"
