"""One thread for linear algebra, so that results do not depend on the number of cores."""

from __future__ import annotations

from threadpoolctl import threadpool_limits


def one_blas_thread() -> threadpool_limits:
    """Limit BLAS to one thread for a ``with`` block.

    The matrices are small: more threads would only wait for one another. Their number also changes the last
    bits of results, such as those of LAPACK's dpotri.
    """
    # A library that is loaded within the block would not be limited. scipy has a BLAS of its own.
    import scipy.linalg  # noqa: F401

    return threadpool_limits(1, user_api="blas")
