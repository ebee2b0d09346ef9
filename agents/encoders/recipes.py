"""How an encoder is made: for each chapter of the thesis its own recipe and a cheap one, with a reason a setting."""

from __future__ import annotations

from dataclasses import dataclass, replace

from imagine_bench.errors import InvalidValueError, require_known

ARCHITECTURES = ("ha_schmidhuber", "strips", "image", "factors", "offered")
"""Of networks; ``"factors"`` gives codes, ``"offered"`` is another package's."""


_MOST = 100_000
"""Latents and images a gradient step, more of which no memory holds."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Settings of one way to make an encoder; the defaults are those of the thesis' chapter 5 (section 5.2.2)."""

    name: str  #: name in its chapter's :data:`RECIPES`
    #: ``"ha_schmidhuber"`` (convolutions), or a small network without: ``"strips"`` reads every channel on its own,
    #: ``"image"`` all together; or ``"factors"``: one categorical value a factor of the scene, which has no gradient
    #: steps and no number of latents to choose.
    architecture: str = "ha_schmidhuber"
    latents: int = 8  #: latents of the whole image, or of each strip
    widths: tuple[int, ...] = ()  #: hidden units of the small network, from the pixels to the latents
    pixel_std: float = 1.0  #: standard deviation of Gaussian pixels, in units of the contrast
    beta: float = 4.0  #: weight of the KL term against a SUM over pixels
    kl_warmup: float = 0.0  #: fraction of the steps over which beta grows from 0
    frames: int = 100_000  #: for codes, up to three channels; more take in proportion
    held_out_frames: int = 10_000  #: fresh frames for the probe's accuracy
    steps: int = 50_000  # 1000 epochs of 50 batches
    batch: int = 2000
    learning_rate: float = 5e-4  #: of Adam, at its highest
    cosine: bool = False  #: whether the learning rate falls to 0 along a half cosine, after a short linear rise
    probe_steps: int = 4000  #: gradient steps of the evaluation-only probe

    @property
    def kind(self) -> str:
        """The output of the encoder: ``"latents"`` (continuous) or ``"codes"`` (categorical)."""
        return "codes" if self.architecture == "factors" else "latents"

    def __post_init__(self) -> None:
        require_known("encoder architecture", self.architecture, ARCHITECTURES)
        least = min(self.latents, self.frames, self.held_out_frames, self.steps, self.batch, self.probe_steps)
        most = max(self.latents, self.batch)
        positive = min(self.pixel_std, self.learning_rate)
        if not (least >= 1 and most <= _MOST and positive > 0 and self.beta >= 0 and 0 <= self.kl_warmup < 1):
            raise InvalidValueError(
                f"Encoder recipe {self.name!r} needs latents, frames, held_out_frames, steps, batch and probe_steps of "
                f"at least 1, latents and batch of at most {_MOST:,}, beta >= 0, pixel_std > 0, learning_rate > 0 and "
                "kl_warmup in [0, 1)."
            )


_STRIPS = Recipe(
    name="default",
    architecture="strips",  # 8 joint latents go to light and jitter, not to arrows, once poses vary
    latents=8,  # a strip: pose 3, arrow 2, hand 1 and two to spare; 4 a strip read 69 %
    widths=(256, 128),
    pixel_std=0.5,  # with beta, sets how small a detail is worth a latent
    beta=2.0,
    kl_warmup=0.2,  # without it the posterior collapses before the decoder has learned anything
    frames=24_000,  # rendering takes 15 s
    held_out_frames=4000,
    steps=2600,  # about a minute
    batch=64,  # 192 strips: more steps in the same time read better than larger batches
    learning_rate=2e-3,
    cosine=True,  # ends in a lower loss within a fixed number of steps
    probe_steps=2500,
)
_IMAGE = replace(
    _STRIPS,
    architecture="image",
    latents=4,  # as in section 3.2.2
    widths=(128, 64),  # the artefact stays below 2 MB
    beta=8.0,  # leaves light and jitter out of the latents that the macrostate does not need
    frames=12_000,
)
_CHAPTER_3 = Recipe(
    name="thesis",
    latents=4,
    beta=1.0,
    frames=1200,  # about 100 of each of the 12 states
    held_out_frames=1200,  # "a separate set of validation images"
    steps=19_000,  # 1000 epochs of 19 batches; the size of a batch is not given
    batch=64,
    learning_rate=1e-4,
)
_JOINT = replace(
    _STRIPS,
    name="joint",  # as many latents as in the thesis and, as there, none that belongs to one cube
    architecture="image",
    beta=4.0,
)
_CODES = Recipe(
    name="codes",
    architecture="factors",
    frames=8000,  # factors and values are found in 6000 of them
    held_out_frames=4000,
    probe_steps=1000,  # one-hot codes are easy to read
)

RECIPES: dict[str, dict[str, Recipe]] = {
    "chapter_3": {"thesis": _CHAPTER_3, "default": _IMAGE, "codes": _CODES},
    "chapter_5": {"thesis": Recipe(name="thesis"), "default": _STRIPS, "joint": _JOINT, "codes": _CODES},
}
"""By the config group that a task names."""


def recipe_named(name: str, family: str) -> Recipe:
    """The recipe of that name for a task of that family.

    Raises:
        UnknownNameError: No such family or recipe; the message lists all of them.
    """
    recipes = RECIPES[require_known("settings family", family, RECIPES)]
    return recipes[require_known("encoder recipe", name, recipes)]
