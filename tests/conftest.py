"""Settings for every test run."""

import torch

# The tests' tensors are small: a second thread costs more in waiting than it gains.
torch.set_num_threads(1)
