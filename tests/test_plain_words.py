"""Values in words for people; what is wrong with JSON is tried where it is read."""

import pytest

from preface.plain_words import counted, disk_space, suggestion


def test_one_thing_is_no_plural():
    assert [counted(n, "identity", "identities") for n in (0, 1, 1200)] == [
        "0 identities",
        "1 identity",
        "1,200 identities",
    ]


@pytest.mark.parametrize(
    ("count", "words"),
    [(0, "0.0 kB"), (9_200, "9.2 kB"), (34.5e6, "34.5 MB"), (256e9, "256.0 GB"), (2e12, "2.0 TB")],
)
def test_room_on_a_disk_has_the_unit_that_suits_it(count, words):
    assert disk_space(count) == words


def test_a_remedy_names_a_close_choice_or_the_first_of_many():
    people = [f"id{number:04d}" for number in range(1450)]
    assert suggestion("id0007x", people) == "Perhaps 'id0007' was meant"
    remedy = suggestion("Somebody", people)
    assert remedy.startswith("Choose one of id0000, id0001, ")
    assert remedy.endswith(", id0011, ... and 1,438 more")
    assert suggestion("?", ["a", "b"]) == "Choose one of a, b"
