"""The bounded cache."""

from rfsg.objects.recent import Recent


def test_what_was_asked_for_longest_ago_is_forgotten():
    made: list[str] = []

    def ask(key: str, state: int = 0) -> str:
        def make() -> str:
            made.append(key)
            return f"{key}{state}"

        return kept.get(key, state, make)

    kept: Recent[str] = Recent(2)
    assert [ask("a"), ask("b"), ask("a"), ask("c"), ask("a")] == ["a0", "b0", "a0", "c0", "a0"]
    assert made == ["a", "b", "c"] and len(kept) == 2
    assert ask("b") == "b0" and made == ["a", "b", "c", "b"]  # it had to go, not "a"


def test_another_state_is_made_anew_and_replaces_the_old_one():
    kept: Recent[int] = Recent(8)
    made = [kept.get("a", state, lambda s=state: 10 * s) for state in (1, 1, 2, 1)]
    assert made == [10, 10, 20, 10] and len(kept) == 1
    assert kept.get("a", 1, lambda: 99) == 10


def test_what_cannot_be_made_is_not_kept():
    kept: Recent[int] = Recent(8)

    def refuse() -> int:
        raise ValueError

    for _ in range(2):
        try:
            kept.get("a", 0, refuse)
        except ValueError:
            pass
    assert len(kept) == 0
