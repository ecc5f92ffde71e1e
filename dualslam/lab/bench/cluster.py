"""Trials on a Dask cluster: the scheduler hands them out, and gives those of a worker that died to another."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from dualslam.core.errors import InputError, how_to_install
from dualslam.lab.bench.plan import Trial
from dualslam.lab.bench.pool import RunTrial
from dualslam.lab.bench.record import TrialOutcome, TrialRecord, blank_record

CONNECT_S = 10


def run_on_cluster(run_trial: RunTrial, trials: Iterable[Trial], address: str) -> Iterator[TrialRecord]:
    """Run trials on the workers of a Dask scheduler, and yield each one's record when it is over.

    The workers need dualslam at the same version, the same paths to the data, and the bench's folder on a file system
    that they share. Start them with one thread each: ``dask worker ADDRESS --nworkers 8 --nthreads 1``.

    Parameters
    ----------
    run_trial : callable
        At the top level of its module.
    trials : iterable of Trial
    address : str
        Of the scheduler, such as ``tcp://host:8786``.

    Raises
    ------
    InputError
        Where dask.distributed is not installed, or no scheduler answers.
    """
    try:
        from distributed import Client, as_completed
    except ImportError as error:
        raise InputError(f"--scheduler needs dask.distributed: {how_to_install('cluster')}.") from error
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"No Dask scheduler answers at {address}; start one with `dask scheduler`.") from error
    with client:
        # Not pure: a trial writes its folder, so that a result of an earlier bench must not stand in for it.
        futures = {client.submit(run_trial, trial, pure=False): trial for trial in trials}
        for future in as_completed(futures, loop=client.loop):
            # Where a worker has died with a result that was not fetched yet, this waits for the trial to be run again.
            lost = future.exception()
            if lost is None:
                yield future.result()
            else:
                # The trial itself catches its exceptions: this is a worker that died with it, time and again.
                yield blank_record(futures[future], TrialOutcome.CRASHED, f"lost on the cluster: {lost!r}"[:500])
