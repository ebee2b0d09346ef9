"""A film shows the arm at work, appears whole, and replaces nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from imagine_bench.errors import SetupError
from imagine_bench.tools.film import HEIGHT_PX, WIDTH_PX, film


@pytest.mark.slow
def test_a_film_reaches_the_goal_and_is_never_overwritten(tmp_path: Path) -> None:
    out = film("arrow_puzzle", tmp_path / "new" / "turn.gif", seed=0)
    with Image.open(out) as gif:
        gray = [np.asarray(picture.convert("L"), dtype=np.float32) for picture in ImageSequence.Iterator(gif)]
    pictures = np.stack(gray)
    assert len(pictures) > 20 and pictures.shape[1] == HEIGHT_PX and pictures.shape[2] > WIDTH_PX
    scene, eye = pictures[:, :, :WIDTH_PX], pictures[:, :, WIDTH_PX:]
    assert np.abs(np.diff(scene, axis=0)).max(axis=(1, 2)).max() > 50, "the arm is seen moving"
    assert np.abs(eye[-1] - eye[0]).max() > 50, "what the agent sees at the end is not what it saw at first"
    assert [path.name for path in out.parent.iterdir()] == ["turn.gif"]
    before = out.read_bytes()
    with pytest.raises(SetupError, match="exists and is not overwritten"):
        film("arrow_puzzle", out, seed=1)
    assert out.read_bytes() == before
