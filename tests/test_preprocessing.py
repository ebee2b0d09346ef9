"""The declared reading of frames: strips hold the right columns, and joining them loses nothing."""

import numpy as np
import pytest

from imagine_bench.errors import UnknownNameError
from imagine_bench.preprocessing import gray_name, join_cells, preprocess, small_rgb, whole_rgb

STARTS = {1: [21], 2: [9, 32], 3: [0, 21, 42], 4: [0, 15, 31, 46], 5: [0, 12, 23, 34, 46], 6: [0, 9, 18, 28, 37, 46]}
"""The first column of each cube, by their number."""


@pytest.mark.parametrize("cubes", STARTS)
def test_each_cube_has_its_own_rows_and_columns(cubes):
    """Red counts columns or rows, green twice, blue thrice. Pixel k of an enlarged cell is at k * 3/4 - 1/8."""
    frames = np.indices((64, 64), dtype=np.uint8)[::-1, ..., None] * np.arange(1, 4, dtype=np.uint8)
    columns, rows = 255 / (0.299 + 2 * 0.587 + 3 * 0.114) * preprocess(gray_name(cubes))(frames)
    for cube, start in enumerate(STARTS[cubes]):
        across, down = start + np.arange(22), np.arange(64)
        if cubes > 3:
            across = start + (np.arange(24) * 0.75 - 0.125).clip(0, 17)
            shown = np.r_[10:28, 46:64] if cube % 2 else np.r_[10:46]
            down = np.interp(np.arange(48) * 0.75 - 0.125, np.arange(36), shown)
        np.testing.assert_allclose(columns[cube], np.add.outer(0 * down, across), atol=1e-3)
        np.testing.assert_allclose(rows[cube], np.add.outer(down, 0 * across), atol=1e-3)


def test_a_column_of_two_strips_is_joined_from_the_left_one():
    strips = np.broadcast_to(np.arange(3.0)[:, None, None], (3, 64, 22))
    np.testing.assert_array_equal(join_cells(strips)[0], np.repeat([0.0, 1.0, 2.0], [22, 21, 21]))


@pytest.mark.parametrize("cubes", range(1, 7))
def test_joined_cells_are_cut_into_the_same_cells(cubes):
    frames = np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3), dtype=np.uint8)
    cells = preprocess(gray_name(cubes))(frames)
    assert cells.dtype == np.float32
    again = np.rint(255 * join_cells(cells)).astype(np.uint8)[..., None].repeat(3, axis=-1)
    np.testing.assert_allclose(preprocess(gray_name(cubes))(again), cells, atol=1 / 255)


def test_rgb_has_its_channels_first_and_is_averaged_over_blocks():
    frames = np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3), dtype=np.uint8)
    np.testing.assert_allclose(whole_rgb(frames), frames.transpose(0, 3, 1, 2) / 255, atol=1e-6)
    pixels = small_rgb(frames)
    assert pixels.shape == (2, 3, 32, 32)
    assert pixels.dtype == np.float32
    assert pixels[1, 2, 5, 31] == pytest.approx(frames[1, 10:12, 62:, 2].mean() / 255, abs=1e-6)
    assert small_rgb(np.full((1, 64, 64, 3), 255, dtype=np.uint8)).max() == 1.0


def test_unknown_preprocessing_lists_the_known_ones():
    with pytest.raises(UnknownNameError, match=r"No preprocessing 'gray_strip'. Did you mean 'gray_strips'\?"):
        preprocess("gray_strip")
