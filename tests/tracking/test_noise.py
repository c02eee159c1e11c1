import numpy as np
import pytest
import tracking_scene as scene

from tracking.markers.noise import noise_of, passes_for, smooth


def test_noise_of_the_chroma_by_hand():
    # R - (G + B) / 2 and sqrt(3) / 2 (G - B) of channels with equal noise: each has sqrt(1.5) times
    # it.
    rng = np.random.default_rng(0)
    frame = np.clip(np.round(rng.normal(120, 10, (480, 640, 3))), 0, 255).astype(np.uint8)
    assert noise_of(frame) == pytest.approx(10 * 1.5**0.5, rel=0.03)


def test_a_quiet_picture_is_left_as_it_is_and_a_noisy_one_is_smoothed():
    rng, image = np.random.default_rng(1), scene.background()
    quiet, noisy = scene.finish(image, rng, noise=2), scene.finish(image, rng, noise=10)
    assert smooth(quiet) is quiet
    assert passes_for(quiet) == 0
    assert noise_of(smooth(noisy)) < 0.3 * noise_of(noisy)
    assert passes_for(noisy) > 0


def test_a_picture_of_a_few_pixels_has_no_noise():
    assert noise_of(np.zeros((4, 4, 3), np.uint8)) == 0
