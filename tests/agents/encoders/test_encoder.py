"""Encoders: the VAE's mathematics, the artefact, training, and the command that trains one anew."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from encoder_frames import CHAPTER_5, QUICK, TINY, TINY_CONV, arrow_spec, draw
from imagine_bench.agents.encoders import perception, training
from imagine_bench.agents.encoders.cli import compare, retrain, sample_sheet
from imagine_bench.agents.encoders.encoder import Encoder, EncoderCard
from imagine_bench.agents.encoders.probe import Latents
from imagine_bench.agents.encoders.recipes import Recipe, recipe_named
from imagine_bench.agents.encoders.training import (
    beta_at,
    draw_frames,
    frame_set,
    learning_rate_at,
    train_encoder,
    train_vae,
)
from imagine_bench.agents.encoders.vae import Vae, build_vae, kl_from_standard_normal, standardise
from imagine_bench.agents.networks.mlp import initialise
from PIL import Image
from safetensors.torch import load_file, save
from torch import Tensor

from imagine_bench.errors import ArtefactError, DivergedError, InvalidValueError, UnknownNameError
from imagine_bench.preprocessing import gray_cells


def made_vae(recipe: Recipe, preprocessing: str = "gray_strips") -> Vae:
    vae = build_vae(recipe, preprocessing)
    initialise(vae, torch.Generator().manual_seed(0))
    return vae


def images(n: int) -> Tensor:
    return torch.from_numpy(gray_cells(frames(n)))


def frames(n: int, appearance: str = "mild") -> np.ndarray:
    return draw_frames(arrow_spec(), appearance, n, np.random.default_rng(0))[0]


def trained(recipe: Recipe, seed: int = 0, appearance: str = "mild", **how: Any) -> Encoder:
    return train_encoder(arrow_spec(), recipe=recipe, appearance=appearance, seed=seed, **how)


@pytest.fixture(scope="module")
def tiny() -> Encoder:
    return trained(TINY)


@pytest.fixture(scope="module", params=["tiny", "tiny_conv"])
def encoder(request: pytest.FixtureRequest, tiny: Encoder) -> Encoder:
    return tiny if request.param == "tiny" else trained(TINY_CONV)


# --- the mathematics -------------------------------------------------------------------------------------------------


def test_kl_is_that_of_torch_distributions() -> None:
    generator = torch.Generator().manual_seed(0)
    mu, log_variance = torch.randn(2, 50, 8, generator=generator, dtype=torch.float64)
    posterior = torch.distributions.Normal(mu, (0.5 * log_variance).exp())
    prior = torch.distributions.Normal(torch.zeros_like(mu), torch.ones_like(mu))
    expected = torch.distributions.kl_divergence(posterior, prior).sum(dim=1)
    torch.testing.assert_close(kl_from_standard_normal(mu, log_variance), expected)
    assert expected.min() > 0.0
    assert kl_from_standard_normal(0.0 * mu, 0.0 * mu).max() == 0.0


def test_strip_loss_is_gaussian_and_summed_over_pixels() -> None:
    vae = made_vae(TINY)
    batch = images(5)
    terms = vae.elbo(batch, torch.zeros(5, 24), beta=2.0)
    mu, log_variance = vae.posterior(batch)
    pixels = torch.distributions.Normal(vae.generate(mu), TINY.pixel_std)
    constant = batch[0].numel() * (math.log(TINY.pixel_std) + 0.5 * math.log(2 * math.pi))
    expected = -pixels.log_prob(vae.target(batch)).sum(dim=(1, 2, 3)).mean() - constant
    torch.testing.assert_close(terms.reconstruction, expected, rtol=1e-4, atol=1e-2)
    torch.testing.assert_close(terms.loss, expected + 2.0 * kl_from_standard_normal(mu, log_variance).mean())
    noise = torch.randn(5, 24, generator=torch.Generator().manual_seed(0))
    drawn = torch.distributions.Normal(mu, (0.5 * log_variance).exp()).icdf(torch.special.ndtr(noise))
    expected = vae.log_loss(vae.generate(drawn), vae.target(batch)).mean()
    torch.testing.assert_close(vae.elbo(batch, noise, beta=2.0).reconstruction, expected, rtol=1e-4, atol=1e-2)
    swapped, _ = vae.posterior(batch.flip(1))
    apart = mu.view(5, 3, 8)
    torch.testing.assert_close(apart.flip(1), swapped.view(5, 3, 8), msg="strips share weights")
    assert not torch.allclose(apart[:, 0], apart[:, 1])


def test_thesis_loss_is_bernoulli_and_summed_over_pixels() -> None:
    vae = made_vae(TINY_CONV)
    batch = images(3)
    target = vae.target(batch)
    p = vae.mean(vae.posterior(batch)[0])
    assert target.shape == p.shape == (3, 3, 64, 64)
    expected = -(target * p.log() + (1 - target) * (1 - p).log()).sum(dim=(1, 2, 3)).mean()
    torch.testing.assert_close(vae.elbo(batch, torch.zeros(3, 8), beta=4.0).reconstruction, expected, rtol=1e-4, atol=0)


def test_images_are_drawn_at_the_usual_brightness_and_contrast() -> None:
    """Those of the training images: their mean, and the mean deviation of pixels within a strip."""
    vae = made_vae(TINY)
    batch = images(5)
    vae.fit_appearance(batch)
    contrast = np.mean([strip.std() for strip in batch.flatten(0, 1).numpy()])
    latents, _ = vae.posterior(batch)
    usual = batch.mean() + contrast * vae.generate(latents)
    torch.testing.assert_close(vae.decode(latents, 64, 22), usual.clamp(0.0, 1.0))


def test_standardised_strips_do_not_see_light() -> None:
    strips = images(4).flatten(2)
    torch.testing.assert_close(standardise(0.3 + 0.5 * strips), standardise(strips), rtol=0.01, atol=0.01)
    deviation, mean = torch.std_mean(standardise(strips), dim=2, correction=0)
    torch.testing.assert_close(mean, torch.zeros(4, 3), rtol=0, atol=1e-5)
    torch.testing.assert_close(deviation, torch.ones(4, 3), rtol=0, atol=0.01)
    assert standardise(torch.full((1, 3, 64 * 22), 0.5)).abs().max() < 1e-3, "a blank strip stays blank"


@pytest.mark.parametrize(
    ("recipe", "preprocessing", "side"),
    [(replace(TINY, architecture="image", latents=8), "small_rgb", 32), (CHAPTER_5["joint"], "gray_strips", 22)],
)
def test_an_image_is_read_whole_and_comes_back_whole(recipe: Recipe, preprocessing: str, side: int) -> None:
    vae = made_vae(recipe, preprocessing)
    batch = torch.rand(5, 3, 32 if side == 32 else 64, side, generator=torch.Generator().manual_seed(1))
    mu, _ = vae.posterior(batch)
    assert mu.shape == (5, 8) and vae.generate(mu).shape == vae.target(batch).shape == batch.shape
    torch.testing.assert_close(vae.target(batch).mean(dim=(1, 2, 3)), torch.zeros(5), rtol=0, atol=1e-5)
    other = batch.clone()
    other[:, 2] = other[:, 2].flip(2)
    assert (vae.posterior(other)[0] - mu).abs().min() > 0  # every latent sees every channel


def test_chapter_3_s_recipe_is_the_thesis() -> None:
    thesis = recipe_named("thesis", "chapter_3")
    assert (thesis.latents, thesis.beta, thesis.learning_rate, thesis.frames) == (4, 1.0, 1e-4, 1200)
    assert round(thesis.steps * thesis.batch / thesis.frames, -1) == pytest.approx(1010, abs=20)  # epochs


def test_thesis_network_is_that_of_ha_and_schmidhuber() -> None:
    vae = build_vae(CHAPTER_5["thesis"], "gray_strips")
    shapes = {name: tuple(weight.shape) for name, weight in vae.named_parameters() if name.endswith("weight")}
    convolutions = [(32, 3, 4, 4), (64, 32, 4, 4), (128, 64, 4, 4), (256, 128, 4, 4)]
    transposed = [(1024, 128, 5, 5), (128, 64, 5, 5), (64, 32, 6, 6), (32, 3, 6, 6)]
    assert list(shapes.values()) == [*convolutions, (16, 1024), (1024, 8), *transposed]
    logits = made_vae(TINY_CONV).generate(torch.randn(3, 8, generator=torch.Generator().manual_seed(0)))
    assert logits.min() < 0.0 < logits.max(), "pixels can be dark and bright"
    thesis = CHAPTER_5["thesis"]
    assert (thesis.latents, thesis.beta, thesis.batch, thesis.learning_rate) == (8, 4.0, 2000, 5e-4)
    assert thesis.steps * thesis.batch == 1000 * thesis.frames == 100_000_000


# --- schedules and recipes -------------------------------------------------------------------------------------------


def test_what_cannot_be_trained_is_named() -> None:
    with pytest.raises(InvalidValueError, match=r"'tiny' needs latents, .* steps, .* of at least 1"):
        replace(TINY, steps=0)
    with pytest.raises(UnknownNameError, match=r"No encoder architecture 'stripes'\. Did you mean 'strips'\?"):
        replace(TINY, architecture="stripes")
    with pytest.raises(DivergedError, match=r"The encoder's loss became (nan|inf) at step 6 of 7"):
        trained(replace(QUICK, learning_rate=1e30))


def test_beta_warms_up_and_the_thesis_has_no_schedule() -> None:
    recipe = replace(TINY, steps=100, kl_warmup=0.2, beta=2.0)
    assert [beta_at(recipe, step) for step in (0, 10, 20, 99)] == [0.0, 1.0, 2.0, 2.0]
    falling = replace(recipe, cosine=True, learning_rate=1.0)
    shares = [learning_rate_at(falling, step) for step in (0, 1, 50, 75)]
    assert shares == pytest.approx([0.05, 0.55, 0.5, 0.5 - 0.5**1.5], rel=1e-3), "over a rise of 2 %, a cosine"
    assert {beta_at(CHAPTER_5["thesis"], step) for step in (0, 10_000)} == {4.0}
    assert {learning_rate_at(CHAPTER_5["thesis"], step) for step in (0, 49_999)} == {5e-4}


def test_every_frame_has_a_draw_of_its_own() -> None:
    latents = Latents(torch.tensor([[1.0, -2.0]]).expand(4000, 2), torch.tensor([[0.5, 3.0]]).expand(4000, 2))
    drawn = latents.sample(torch.Generator().manual_seed(0))
    assert torch.allclose(drawn.mean(dim=0), latents.mu[0], atol=0.2)
    assert torch.allclose(drawn.std(dim=0), latents.sigma[0], rtol=0.05)


# --- training --------------------------------------------------------------------------------------------------------


def weights(encoder: Encoder) -> Tensor:
    return torch.nn.utils.parameters_to_vector([*encoder.network.parameters(), *encoder.probe.parameters()])


def test_killed_training_goes_on_to_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "SAVE_EVERY_S", 0.0)
    file = tmp_path / "unfinished.pt"
    told: list[str] = []
    before = torch.get_rng_state()
    theirs = np.random.get_state()[1].copy()  # noqa: NPY002
    whole = trained(QUICK)

    def killed(stage: str, done: float) -> None:
        if stage == "training" and done > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trained(QUICK, progress=killed, unfinished=file)
    again = trained(QUICK, unfinished=file, progress=lambda stage, _: told.append(stage))
    assert told.count("training") == 3, "four of seven were done"
    assert torch.equal(before, torch.get_rng_state())
    assert np.array_equal(theirs, np.random.get_state()[1])  # noqa: NPY002
    assert torch.equal(weights(whole), weights(again))
    assert replace(again.card, cpu_s={}) == replace(whole.card, cpu_s={})
    for other in ({"seed": 1}, {"appearance": "clean"}, {"recipe": replace(QUICK, beta=9.0)}):
        with pytest.raises(ArtefactError, match="is of another training; remove it or choose"):
            trained(**{"recipe": QUICK, **other}, unfinished=file)
    file.write_bytes(file.read_bytes()[:5000])
    with pytest.raises(ArtefactError, match=r"unfinished\.pt is damaged; remove it to begin anew"):
        trained(QUICK, unfinished=file)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU")
@pytest.mark.parametrize("recipe", [TINY, TINY_CONV], ids=lambda recipe: recipe.name)
def test_a_gpu_repeats_itself_and_agrees_with_the_processor(recipe: Recipe) -> None:
    on_cpu, on_gpu, again = (trained(replace(recipe, steps=20), device=device) for device in ("cpu", "cuda", "cuda"))
    of_cpu, of_gpu, repeated = (encoder.encode(frames(10))[0] for encoder in (on_cpu, on_gpu, again))
    assert torch.equal(of_gpu, repeated)
    torch.testing.assert_close(of_gpu, of_cpu, rtol=0.05, atol=0.05)
    assert on_gpu.card.command == f"{on_cpu.card.command} --device cuda"
    assert on_gpu.card.versions["gpu"]


def test_probes_read_frames_and_looks_that_training_never_saw(tiny: Encoder) -> None:
    drawn: list[tuple[str, np.ndarray, np.ndarray]] = []

    def noted(macrostates: np.ndarray, appearance: str, rng: np.random.Generator) -> np.ndarray:
        drawn.append((appearance, macrostates, draw(macrostates, appearance, rng)))
        return drawn[-1][2]

    spec = replace(arrow_spec(), render_macrostates=noted)
    made = train_encoder(spec, recipe=QUICK, appearance="photo", seed=0)
    read = [
        float((made.read_macrostate(made.encode(seen)[0]) == states).all(axis=1).mean()) for _, states, seen in drawn
    ]
    assert made.card.probe["mlp"] == pytest.approx(read[1]) != pytest.approx(read[0]), "measured on frames held out"
    mu, sigma = made.encode(drawn[1][2])
    information = 0.5 * (mu.square() + sigma.square() - 1.0 - 2.0 * sigma.log()).sum(dim=1).mean()
    assert made.card.kl_nats == pytest.approx(information.item(), abs=2e-3)
    away = made.network.mean(mu) - made.network.target(torch.from_numpy(gray_cells(drawn[1][2])))
    assert made.card.reconstruction == pytest.approx(away.square().mean().item(), rel=0.01)
    assert tiny.card.probe["linear"] < tiny.card.probe["mlp_sampled"] < tiny.card.probe["mlp"]
    assert [(looks, len(seen)) for looks, _, seen in drawn] == [("photo", 60), ("photo_held_out", 30)]
    first, second = ({frame.tobytes() for frame in seen} for *_, seen in drawn)
    assert first.isdisjoint(second)


def test_gradients_of_parts_add_up_to_the_batch_s() -> None:
    recipe = replace(QUICK, steps=1, frames=300, batch=300)
    data = frame_set(arrow_spec(), "mild", 300, np.random.default_rng(0), lambda stage, done: None)
    vae = made_vae(recipe)
    plain = copy.deepcopy(vae)
    train_vae(vae, data, recipe, torch.Generator().manual_seed(0), lambda stage, done: None)
    draws = torch.Generator().manual_seed(0)
    rows = torch.randperm(300, generator=draws)
    noise = torch.randn((300, vae.latent_size), generator=draws)
    plain.elbo(data.batch(rows), noise, beta_at(recipe, 0)).loss.backward()
    for one, other in zip(vae.parameters(), plain.parameters(), strict=True):
        torch.testing.assert_close(one.grad, other.grad, rtol=1e-3, atol=1e-4 * float(other.grad.abs().max()))


# --- the artefact ----------------------------------------------------------------------------------------------------


def test_saved_and_loaded_encoders_are_equal(encoder: Encoder, tmp_path: Path) -> None:
    encoder.save(tmp_path / "e.safetensors")
    loaded = Encoder.load(tmp_path / "e.safetensors")
    mu, sigma = encoder.encode(frames(7))
    assert all(map(torch.equal, (mu, sigma), loaded.encode(frames(7))))
    assert np.array_equal(loaded.decode(mu), encoder.decode(mu))
    assert np.array_equal(loaded.read_macrostate(mu), encoder.read_macrostate(mu))
    assert loaded.card == encoder.card == EncoderCard.from_json((tmp_path / "e.json").read_text())
    (tmp_path / "e.safetensors").unlink()
    with pytest.raises(ArtefactError, match=r"e\.json exists already and is never overwritten"):
        encoder.save(tmp_path / "e.safetensors")


def test_shapes_types_and_ranges_also_beyond_one_chunk(encoder: Encoder) -> None:
    many = np.random.default_rng(0).integers(256, size=(600, 64, 64, 3), dtype=np.uint8)
    mu, sigma = encoder.encode(many)
    assert len(encoder.encode(many[:0])[0]) == 0
    assert mu.shape == sigma.shape == (600, encoder.latent_size)
    assert not mu.requires_grad and (sigma > 0).all()
    torch.testing.assert_close(encoder.encode(many[511:514])[0], mu[511:514], rtol=0, atol=1e-5)
    images = encoder.decode(mu[:30])
    assert images.shape == (30, 64, 64) and ((images >= 0.0) & (images <= 1.0)).all()
    read = encoder.read_macrostate(mu)
    assert read.shape == (600, 4) and ((read >= 0) & (read < (4, 4, 4, 3))).all()
    for wrong in (many.astype(np.float32), many[0]):
        with pytest.raises(InvalidValueError, match=rf"type {wrong.dtype} and shape \({len(wrong)}, .*give uint8 of"):
            encoder.encode(wrong)


def test_bad_files_are_named_and_left_untouched(tiny: Encoder, tmp_path: Path) -> None:
    path = tmp_path / "e.safetensors"
    tiny.save(path)
    good = path.read_bytes()
    state = load_file(path)
    card = json.loads(tiny.card.to_json())

    def saved(tensors: dict[str, Tensor], **changes: object) -> bytes:
        return save(tensors, metadata={"card": json.dumps({**card, **changes})})

    renamed = {name.replace("vae.brightness", "vae.light"): tensor for name, tensor in state.items()}
    bad = {
        good[:5000]: "",
        good[:-1] + bytes([good[-1] ^ 1]): "it is not as it was written",
        saved(state, format="something/2"): "its format is not",
        saved(state, latents=1): "it has 'latents', which is unknown",
        saved(state, latent_size=card["latent_size"] + 1): r"tensor \S+ has shape \(.*, not \(",
        saved({**state, "vae.brightness": torch.tensor(math.nan)}): r"tensor vae\.brightness is not finite",
        saved(renamed): r"of the tensors vae\.\* it lacks \['brightness'\] and has \['light'\] instead",
    }
    path.write_bytes(saved(state))
    assert Encoder.load(path).card == tiny.card, "the negatives below are not vacuous"
    for content, reason in bad.items():
        path.write_bytes(content)
        with pytest.raises(ArtefactError, match=rf"e\.safetensors is not a usable encoder \(.*{reason}.*\); choose"):
            Encoder.load(path)
        assert path.read_bytes() == content


def test_a_full_memory_of_frames_forgets_the_oldest(tiny: Encoder) -> None:
    sees = perception.Perception(tiny)
    shown = np.random.default_rng(0).integers(256, size=(2_003, 64, 64, 3), dtype=np.uint8)
    for frame in shown:
        mu, _ = sees.posterior(frame)
    assert torch.equal(mu, tiny.encode(shown[-1:])[0][0])
    assert [frame.tobytes() for frame in shown[3:]] == list(sees._recent)


def test_a_sheet_names_each_reading_red_where_it_is_wrong(encoder: Encoder) -> None:
    shown = frames(3)
    read = encoder.read_macrostate(encoder.encode(shown)[0])
    truth = read.copy()
    truth[1, 0] = (truth[1, 0] + 1) % 4
    figure = sample_sheet(encoder, arrow_spec(), shown, truth, torch.Generator().manual_seed(0))
    below = [axes.xaxis.label for axes in figure.axes[-3:]]
    assert [label.get_text().split("\n") for label in below] == [list(arrow_spec().value_names(each)) for each in read]
    assert [label.get_color() for label in below] == ["black", "red", "black"]


def made(out: Path, recipe: Any = QUICK, appearance: str = "mild", **how: Any) -> str:
    return retrain(arrow_spec(), recipe=recipe, appearance=appearance, seed=1, out=out, **how)


def test_retrain_leaves_three_files_and_never_overwrites(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "SAVE_EVERY_S", 0.0)
    monkeypatch.setitem(CHAPTER_5, "quick", QUICK)
    text = made(tmp_path, "quick", batch=9, latents=11)
    path = tmp_path / "drawn_arrows-mild.safetensors"
    card = Encoder.load(path).card
    assert f"Wrote {path}" in text
    shares = {"linear": 0.5, "mlp": 0.75, "mlp_sampled": 0.12345}
    bundled = replace(card, seed=4, latent_size=7, probe=shares, kl_nats=2.34, cpu_s={"total": 98.7})
    assert compare(card, None) == text.splitlines()[1] and f"mlp {card.probe['mlp']:.2%}" in text
    assert compare(card, bundled).splitlines() == [
        text.splitlines()[1],
        "bundled: recipe quick, seed 4, 7 latents; of 30 held-out frames read right: linear 50.00%, mlp 75.00%, "
        "mlp_sampled 12.35%; 2.3 nats from the prior, 99 CPU s.",
    ]
    assert (card.recipe.steps, card.recipe.batch, card.recipe.latents) == (QUICK.steps, 9, 11)
    assert card.data.startswith("60 training and 30 held-out frames")
    command = "imagine-bench encoder --task drawn_arrows --appearance mild --recipe quick --seed 1"
    assert card.command == f"{command} --batch 9 --latents 11"
    with Image.open(path.with_suffix(".png")) as sheet:
        assert np.asarray(sheet).std() > 20
        assert sheet.width > 1000
    written = {file: file.read_bytes() for file in tmp_path.iterdir()}
    assert len(written) == 3
    with pytest.raises(ArtefactError, match="exists already and is never overwritten"):
        made(tmp_path)
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == written


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"recipe": "defualt"}, r"No encoder recipe 'defualt'. Did you mean 'default'"),
        ({"appearance": "x"}, "Known: clean, mild, strong"),
        ({"latents": 0}, "needs latents, frames"),
        ({"recipe": "codes", "steps": 1, "latents": 11}, r"gradient steps; leave out --steps 1 --latents 11\."),
        ({"recipe": "codes", "device": "cuda"}, "leave out --device cuda"),
    ],
)
def test_wrong_choices_are_named_before_anything_is_made(tmp_path: Path, how: dict[str, Any], message: str) -> None:
    with pytest.raises((InvalidValueError, UnknownNameError), match=message):
        made(tmp_path / "new", **how)
    assert not (tmp_path / "new").exists()
