"""How far the fit of a field has got: a bar with its present stage."""
from contextlib import contextmanager

from photutils_mgauss.utils import waiting


@contextmanager
def progress(workers, shown):
    """
    Show a bar while stars are fitted, if that is wanted.

    How many steps there will be is not known before the last one, so that
    the bar counts how often pixels were gone through and says what for.
    """
    if not shown:
        yield
        return
    with waiting.progress(desc='PSF field', unit=' passes') as bar:
        def told(stage):
            if stage is None:
                bar.update()
            else:
                bar.set_postfix_str(stage)
        workers.told = told
        try:
            yield
        finally:
            workers.told = None
