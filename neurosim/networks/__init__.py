"""Product/summation-unit networks; they know only tensors."""

from neurosim.networks.population_error import PopulationError
from neurosim.networks.prediction import Prediction
from neurosim.networks.product_gram import ProductGram
from neurosim.networks.product_units import LOG_LIMIT, ProductSummationNetwork, Weights

__all__ = [
    "LOG_LIMIT",
    "PopulationError",
    "Prediction",
    "ProductGram",
    "ProductSummationNetwork",
    "Weights",
]
