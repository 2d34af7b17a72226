"""Settings for every test run."""

import pytest
import torch

# The tests' tensors are small: a second thread costs more in waiting than it gains.
torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _same_random_numbers() -> None:
    """Each test draws the same numbers in every run and order: what passes today passes tomorrow."""
    torch.manual_seed(0)
