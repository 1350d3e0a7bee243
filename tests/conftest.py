"""What several tests share."""

from collections.abc import Callable, Iterator

import pytest

from pneuopt import compiler, kernels

CACHES = (compiler.build, compiler.say_once, compiler._compiler_version, compiler._temporary_folder, kernels.prepared)


def _forget() -> None:
    for cache in CACHES:
        cache.cache_clear()


@pytest.fixture
def forget(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], None]]:
    """Nothing is remembered of what was built or said, before and after; call it to forget again."""
    _forget()
    yield _forget
    _forget()
