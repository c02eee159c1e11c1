"""From a dataset to a simulator, and how well it predicts."""

from neurosim.training.evaluate import evaluate
from neurosim.training.train import train
from neurosim.training.trainers.registry import TRAINERS

__all__ = ["TRAINERS", "evaluate", "train"]
