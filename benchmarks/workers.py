"""Where independent runs are done: in processes of this machine, or on a Dask or Ray cluster."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from joblib import parallel_config


@dataclass(frozen=True, kw_only=True)
class Workers:
    """Where runs are done."""

    jobs: int = 1
    """Runs at a time; each uses one core."""
    backend: Literal["loky", "dask", "ray"] = "loky"
    """Local processes, or a Dask or Ray cluster (packages `distributed`, `ray`) that sees the same folders."""
    cluster: str | None = None
    """Address of the cluster's scheduler; by default a local one is started."""


@contextlib.contextmanager
def at_work(options: Workers) -> Iterator[None]:
    """Make joblib send its work where the options say."""
    if options.backend == "loky":
        # BLAS and numba of the workers get one thread each.
        with parallel_config(backend="loky", **({"inner_max_num_threads": 1} if options.jobs > 1 else {})):
            yield
        return
    try:
        start = _start_dask if options.backend == "dask" else _start_ray
        with start(options), parallel_config(backend=options.backend):
            yield
    except ImportError as error:
        raise SystemExit(
            f"--backend {options.backend} needs a package that is not installed ({error}); "
            f"pip install -e '.[cluster]' for Dask, `pip install ray` for Ray"
        ) from error


def _start_dask(options: Workers) -> contextlib.AbstractContextManager:
    from distributed import Client, LocalCluster

    if options.cluster:
        return Client(options.cluster)
    return Client(LocalCluster(n_workers=options.jobs, threads_per_worker=1, dashboard_address=None))


@contextlib.contextmanager
def _start_ray(options: Workers) -> Iterator[None]:
    import ray
    from ray.util.joblib import register_ray

    ray.init(address=options.cluster, num_cpus=None if options.cluster else options.jobs)
    register_ray()
    try:
        yield
    finally:
        ray.shutdown()
