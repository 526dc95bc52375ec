"""What the page says, and that names of strangers are no markup in it."""

import math

from rfsg.view import words


def test_names_are_shown_as_they_are():
    assert words.plain("a\n  b") == "a b"
    hostile = "<img src=x> [a](javascript:b) *c* `d` |e|"
    shown = words.plain(hostile)
    for letter in "<>[]()*`|":
        assert shown.count(letter) == shown.count(f"\\{letter}") == hostile.count(letter)
    assert shown.replace("\\", "") == hostile  # and nothing is lost


def test_the_last_name_of_a_path():
    assert words.short("/World/Shell/Wall") == "Wall" and words.short("Wall") == "Wall"


def row(**changes):
    numbers = {"path_gain_db": -61.234, "rss_dbm": -41.234, "delay_spread_ns": 3.456}
    spreads = {f"{name}_deg": 10.0 for name in ("asd", "asa", "zsd", "zsa")}
    return {**numbers, **spreads, "k_factor_db": 7.0, "n_paths": 5, "los": True} | changes


def test_numbers_of_a_link_have_their_units():
    said = words.rows(row())
    assert said["path gain"] == "-61.23 dB" and said["received"] == "-41.23 dBm"
    assert said["delay spread"] == "3.46 ns" and said["line of sight"] == "yes"
    assert words.rows(row(k_factor_db=math.inf))["K factor"] == "one path"
    assert words.rows(row(n_paths=0, path_gain_db=-math.inf)) == {"paths": "nothing arrives"}
    assert words.numbers(None) == "no numbers yet"
    assert words.numbers(row()).count("\n") == len(said) + 1  # a line each, and the head


def test_a_scale_has_its_name_escaped_and_its_ends():
    bar = words.scale_bar("<b>gain", -95.0, -50.0, "dB", "plasma")
    assert "<b>" not in bar and "&lt;b&gt;gain [dB]" in bar
    assert all(f">{end}<" in bar for end in ("-95", "-50"))
