"""Noise of native libraries is held back; what could matter is not, also when what is called fails."""

import os
import re

import pytest

from preface.capture.chatter import without_chatter

NOISE = re.compile("hum")


def test_noise_is_held_back_and_all_else_is_passed_on(capfd):
    with without_chatter(NOISE):
        os.write(2, b"hum of the fan\nno room on the disk\nthe hum is not first here\n")
    os.write(2, b"hum, but not within\n")
    assert capfd.readouterr().err == "no room on the disk\nthe hum is not first here\nhum, but not within\n"


def test_what_was_said_before_a_failure_is_told(capfd):
    def fails():
        with without_chatter(NOISE):
            os.write(2, b"hum\nthe cable is out\n")
            raise OSError("gone")

    with pytest.raises(OSError, match="gone"):
        fails()
    assert capfd.readouterr().err == "the cable is out\n"
