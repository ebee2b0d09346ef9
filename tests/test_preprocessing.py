"""The declared reading of frames: strips hold the right columns, and joining them loses nothing."""

import numpy as np
import pytest

from imagine_bench.errors import UnknownNameError
from imagine_bench.preprocessing import gray_cells, gray_name, join_cells, preprocess, small_rgb, whole_rgb


def test_strips_hold_the_columns_of_their_cube():
    frames = np.zeros((1, 64, 64, 3), dtype=np.uint8)
    frames[:, :, :, :] = np.arange(64, dtype=np.uint8)[None, None, :, None]  # gray level = column
    strips = gray_cells(frames)
    assert strips.shape == (1, 3, 64, 22) and strips.dtype == np.float32
    for strip, start in zip(strips[0], (0, 21, 42), strict=True):
        np.testing.assert_allclose(strip[0] * 255, np.arange(start, start + 22), atol=1e-3)


def test_joined_strips_are_the_gray_frame():
    frames = np.random.default_rng(0).integers(0, 256, (5, 64, 64, 3), dtype=np.uint8)
    gray = frames @ np.array([0.299, 0.587, 0.114]) / 255
    np.testing.assert_allclose(join_cells(gray_cells(frames)), gray, atol=1e-6)


def test_a_column_of_two_strips_is_joined_from_the_left_one():
    strips = np.broadcast_to(np.arange(3.0)[:, None, None], (3, 64, 22))
    np.testing.assert_array_equal(join_cells(strips)[0], np.repeat([0.0, 1.0, 2.0], [22, 21, 21]))


@pytest.mark.parametrize("cubes", range(1, 7))
def test_joined_cells_are_cut_into_the_same_cells(cubes):
    frames = np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3), dtype=np.uint8)
    cells = preprocess(gray_name(cubes))(frames)
    assert cells.shape[:2] == (2, cubes) and cells.dtype == np.float32
    assert cells.min() >= 0.0 and cells.max() <= 1.0
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
