"""A Ray cluster, which distributes work to many computers."""

from __future__ import annotations

import logging
from typing import Any, Literal

from neurosim.base.errors import UserError

#: Places to work: this process or this computer, or a Ray cluster.
Name = Literal["local", "ray"]


def ray_cluster() -> Any:
    """Return Ray, connected to an existing cluster or to a new one on this computer.

    Raises:
        UserError: if Ray is not installed or its cluster cannot be reached.
    """
    try:
        import ray
    except ImportError:
        raise UserError(
            "the workers ray need the package Ray: pip install 'neurosim[ray]'"
        ) from None
    if not ray.is_initialized():
        try:
            ray.init(log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, RuntimeError, ValueError) as error:
            why = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise UserError(
                f"no Ray cluster can be reached or started ({why}); see RAY_ADDRESS"
            ) from None
    return ray
