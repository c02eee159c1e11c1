"""Networks, mainly of product and summation units; they know only tensors."""

from neurosim.networks.expanded import Expanded
from neurosim.networks.population_error import PopulationError
from neurosim.networks.prediction import Prediction
from neurosim.networks.product_units import LOG_LIMIT, ProductSummationNetwork, Weights

__all__ = [
    "Expanded",
    "LOG_LIMIT",
    "PopulationError",
    "Prediction",
    "ProductSummationNetwork",
    "Weights",
]
