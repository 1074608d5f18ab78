"""How far work is, in a log: lines, not too many, with what is left by the work and not by the number of things."""

import io
import itertools
import sys

import pytest

from preface import progress
from preface.progress import Progress


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands until it is told to go on."""

    class Clock:
        now = 1000.0

    monkeypatch.setattr(progress, "monotonic", lambda: Clock.now)
    return Clock


def test_a_line_comes_every_half_minute_whether_or_not_something_is_done(clock, capsys):
    with Progress(4, "images") as told:
        assert capsys.readouterr().err == ""
        for seconds, things, line in (
            (29, 0, ""),
            (1, 0, "0 of 4 images, 30 s\n"),
            (10, 1, ""),
            (20, 0, "1 of 4 images, 60 s, about 3 min left\n"),
        ):
            clock.now += seconds
            told.add(things)
            assert capsys.readouterr().err == line
        told.add(3)
    assert capsys.readouterr().err == "4 of 4 images, 60 s\n"


def test_how_many_there_are_need_not_be_known(clock, capsys):
    with Progress(0, "frames") as told:
        clock.now += 40
        told.add(7)
        assert capsys.readouterr().err == "7 frames, 40 s\n"


def test_what_is_left_is_told_by_the_work(clock, capsys):
    """The first of two things is most of the work."""
    with Progress(2, "images", 10.0) as told:
        clock.now += 90
        told.add(1, 9.0)
        assert "1 of 2 images, 90 s, about 10 s left" in capsys.readouterr().err
        told.add(1, 1.0)


def test_a_day_of_work_leaves_a_hundred_lines_and_no_gap_of_two_hours(clock, capsys):
    began, said = clock.now, []
    with Progress(8640, "heads") as told:
        for _ in range(8640):
            clock.now += 10
            told.add(1)
            if capsys.readouterr().err:
                said.append(clock.now - began)
    assert 50 < len(said) < 150
    assert max(later - earlier for earlier, later in itertools.pairwise(said)) < 7200


def fail_after_one():
    with Progress(2, "images") as told:
        told.add(1)
        raise ValueError("broken")


def test_work_that_fails_is_not_told_as_done(clock, capsys):
    with pytest.raises(ValueError, match="broken"):
        fail_after_one()
    assert capsys.readouterr().err == ""


def test_a_terminal_has_a_bar_and_no_lines(clock, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    with Progress(2, "images") as told:
        clock.now += 60
        told.add(2)
    assert "2 of 2 images: 100%" in screen.getvalue()
    assert "60 s" not in screen.getvalue()
