"""From a dataset to a simulator, and the errors of its predictions."""

from neurosim.training.evaluate import evaluate
from neurosim.training.train import train
from neurosim.training.trainers.registry import TRAINERS

__all__ = ["TRAINERS", "evaluate", "train"]
