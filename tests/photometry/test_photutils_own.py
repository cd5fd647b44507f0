"""
Photutils' own tests of PSFPhotometry, run on the class of this package.

Once with photutils' models, which photutils fits for us, and once with its
Gaussian replaced by a mixture of one Gaussian, which the compiled engine
fits. What differs on purpose is listed with its reason, here and in
docs/contract.rst.
"""
import contextlib

import numpy as np
import photutils
import pytest
from astropy.stats import gaussian_fwhm_to_sigma
from astropy.utils import minversion

from photutils_mgauss import (
    GaussianMixture,
    MixturePSFPhotometry,
    MultiGaussianPSFModel,
)

theirs = pytest.importorskip('photutils.psf.tests.test_photometry')
with contextlib.suppress(ImportError):  # photutils 3.0 has no such file
    from photutils.psf.tests.conftest import *  # noqa: F403
globals().update({name: value for name, value in vars(theirs).items()
                  if name.startswith(('test_', 'fixture_', 'Test'))})

pytestmark = pytest.mark.filterwarnings(
    'ignore:Photutils fits the stars, without compiled code',
    'ignore:data has no pixel that can be used')

OWN_WORDS = 'the same is refused in words of our own'

# Test -> why it does not hold of MixturePSFPhotometry, with either model.
DIFFERENT = {
    'test_invalid_inputs': OWN_WORDS,
    'test_psf_photometry_compound_psfmodel': (
        'the default fitter is ours, and converges where theirs does not'),
    'test_n_threads_gil_fallback': (
        'the default fitter is ours, and the last digits differ'),
    'test_n_threads_gil_fallback_single_group[their model]': (
        'that photutils fits is said in a warning'),
}
if not minversion(photutils, '3.1'):
    DIFFERENT['test_fixed_params'] = OWN_WORDS

# With the mixture.
OF_THE_MIXTURE = {
    'test_psf_photometry_forced[mixture-True]': 'a mixture has no fwhm',
    'test_fit_warning': 'a mixture has no fwhm',
    'test_psf_photometry_table_serialization': (
        'the table names the model that was fitted'),
    'test_psf_photometry_finite_weights': OWN_WORDS,
    'test_row_index_not_leaked_on_failure': OWN_WORDS,
    'test_error_weights_message_has_source_context': OWN_WORDS,
    'test_n_threads_fit_error': OWN_WORDS,
    'test_all_params_fixed': OWN_WORDS,
    'test_n_threads_build_detection': (
        'compiled fits run in threads on any Python, without a warning'),
}


def gaussian_mixture(*, flux=1, x_0=0, y_0=0, fwhm=1):
    """Return a mixture that is photutils' CircularGaussianPRF."""
    variance = (fwhm * gaussian_fwhm_to_sigma) ** 2
    mixture = GaussianMixture([1], [[0, 0]], [variance * np.eye(2)])
    return MultiGaussianPSFModel(mixture, flux=flux, x_0=x_0, y_0=y_0,
                                 pixel_integrated=True)


@pytest.fixture(autouse=True, params=['their model', 'mixture'])
def ours(request, monkeypatch):
    """Put our class, and a mixture, in the place of theirs."""
    monkeypatch.setattr(theirs, 'PSFPhotometry', MixturePSFPhotometry)
    different = DIFFERENT
    if request.param == 'mixture':
        monkeypatch.setattr(theirs, 'CircularGaussianPRF', gaussian_mixture)
        different = DIFFERENT | OF_THE_MIXTURE
    reason = different.get(request.node.name,
                           different.get(request.node.originalname))
    if reason:
        request.applymarker(pytest.mark.xfail(reason=reason, strict=True))
