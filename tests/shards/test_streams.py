"""Random numbers: SplitMix64 as others have it, uniform, and any part without the rest."""

import numpy as np
import pytest

from preface.shards import compiled_draws
from preface.shards.streams import (
    below,
    below_by_numpy,
    bits,
    mix64,
    permutation,
    stream_key,
    without_replacement,
)


def test_the_stream_is_splitmix64():
    # The reference outputs of SplitMix64 for the seed 1234567 (Vigna's splitmix64.c; Rosetta Code).
    expected = [6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431]
    assert bits(1234567, 0, 4).tolist() == expected
    assert mix64(1234567 + 0x9E3779B97F4A7C15) == expected[0]


def test_a_part_of_a_stream_is_that_part():
    whole = bits(99, 0, 1000)
    assert np.array_equal(bits(99, 137, 300), whole[137:437])


def test_numbers_are_uniform_and_below_their_limit():
    drawn = below(stream_key(1, 2), 0, 200_000, 7)
    counts = np.bincount(drawn, minlength=7)
    assert len(counts) == 7
    chi_square = ((counts - 200_000 / 7) ** 2 / (200_000 / 7)).sum()
    assert chi_square < 22.5  # 0.1% of chi-square with six degrees of freedom
    limits = np.array([1, 2, 2**40])
    assert (below(5, 0, 3, limits) < limits).all()


@pytest.mark.parametrize("limit", [1, 2, 3, 98_304, 3 * 2**24, 2**40 + 1, 2**53 - 1, 2**53])
def test_compiled_and_numpys_numbers_are_those_of_whole_arithmetic(limit):
    key, begin = stream_key(8, limit), 2**40
    # floor(number / 2^53 * limit), where the product is rounded to a float64; in whole numbers of Python.
    numbers = [mix64((key + (begin + 1 + i) * 0x9E3779B97F4A7C15) % 2**64) >> 11 for i in range(3000)]
    expected = [min(int(float(n * limit) / 2**53), limit - 1) for n in numbers]
    assert compiled_draws.below(key, begin, 3000, limit).tolist() == expected
    assert below_by_numpy(key, begin, 3000, limit).tolist() == expected
    assert below(key, begin, 3000, limit).tolist() == expected
    assert below(key, begin, 3, limit).tolist() == expected[:3]


def test_keys_depend_on_every_word_and_its_place():
    words = [(1, 2), (2, 1), (1, 2, 0), (0, 1, 2), (1, 3), (-1, 2), (1,)]
    assert len({stream_key(*w) for w in words}) == len(words)


def test_drawing_without_replacement_takes_everything_before_it_repeats():
    allowed = np.array([[1, 1, 0, 1, 1], [0, 0, 1, 0, 0]], bool)
    drawn = without_replacement(3, 2, allowed, 9)
    assert sorted(drawn[0, :4]) == sorted(drawn[0, 4:8]) == [0, 1, 3, 4]
    assert set(drawn[1]) == {2}


def test_each_column_comes_first_equally_often():
    allowed = np.array([[1, 1, 0, 1]] * 20_000, bool)
    counts = np.bincount(without_replacement(11, 20_000, allowed, 1)[:, 0], minlength=4)
    assert counts[2] == 0
    assert np.abs(counts[[0, 1, 3]] - 20_000 / 3).max() < 4 * np.sqrt(20_000 * 2 / 9)


def test_the_permutation_is_one_and_never_changes():
    order, slots = permutation(480)
    assert np.array_equal(np.sort(order), np.arange(480))
    assert np.array_equal(order[slots], np.arange(480))
    # The definition again, in whole numbers of Python: part of the format.
    key = int.from_bytes(b"preface1", "big")
    keys = [mix64((key + (i + 1) * 0x9E3779B97F4A7C15) % 2**64) for i in range(480)]
    assert order.tolist() == sorted(range(480), key=keys.__getitem__)
