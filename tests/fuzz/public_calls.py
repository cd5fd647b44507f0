"""One small valid call of every public function, with all its arguments."""
from functools import partial

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from astropy.time import Time
from astropy.wcs import WCS

import photutils_mgauss as mg

SHAPE = (64, 64)


def mixture(size=1.0):
    return mg.GaussianMixture.from_stddevs(
        [0.6, 0.4], [(0, 0), (0.1, 0)],
        [(size, 1.1 * size), (2 * size, 2.2 * size)], [0.1, 0])


def grid():
    return mg.GriddedMixturePSF(
        [mixture(1 + 0.02 * k) for k in range(4)],
        [(x, y) for y in (0, 63) for x in (0, 63)])


def stars(ending=''):
    rng = np.random.default_rng(3)
    y, x = (axis.ravel() for axis in np.mgrid[10:60:11, 10:60:11])
    return QTable({f'x{ending}': x + rng.uniform(-.5, .5, x.size),
                   f'y{ending}': y + rng.uniform(-.5, .5, x.size),
                   f'flux{ending}': rng.uniform(2e4, 9e4, x.size)})


def image():
    table = stars()
    light = mg.render_stars(grid(), *table.itercols(), SHAPE)
    return light + np.random.default_rng(4).normal(0, 10, SHAPE)


def pixels():
    return {'data': image(), 'error': np.full(SHAPE, 10.0),
            'mask': np.zeros(SHAPE, bool)}


def stamp():
    noise = np.random.default_rng(5).normal(0, 0.1, (21, 21))
    return {'image': mixture().render((21, 21), 10.1, 9.8, flux=1e3) + noise,
            'error': np.full((21, 21), 0.1),
            'mask': np.zeros((21, 21), bool)}


def wcs():
    out = WCS(naxis=2)
    out.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    out.wcs.crval = 10, 20
    out.wcs.crpix = 32, 32
    out.wcs.cdelt = -2e-5, 2e-5
    return out


def measured(shift=0.0):
    table = stars('_fit')
    n = len(table)
    table['x_fit'] += shift
    return QTable({'id': np.arange(n), **{
        name: table[name] for name in table.colnames},
        'x_err': np.full(n, 0.01), 'y_err': np.full(n, 0.01),
        'flux_err': np.sqrt(table['flux_fit'])})


def epochs():
    return [mg.Epoch(measured(0.01 * k), wcs(), Time(f'202{k}-01-01'))
            for k in range(3)]


def photometry(cls, data, error, mask, init_params=None, **options):
    """Make an object for photometry and call it."""
    given = {} if init_params is None else {'init_params': init_params}
    return cls(**options)(data, error=error, mask=mask, **given)


def motions(epochs, **options):
    return mg.ProperMotionFitter(**options).fit(epochs)


def motions_with(**options):
    return motions([mg.Epoch(**options), *epochs()[1:]])


def mixtures():
    mix, steps = mixture(), {'x': 1.0, 'y': 2.0}
    identity = np.eye(2)
    pairs = {'weights': [.5, .5], 'means': [(0, 0), (0, 0)]}
    return {
        'GaussianMixture': (mg.GaussianMixture, {
            **pairs, 'covariances': [identity, identity]}),
        'GaussianMixture.from_stddevs': (mg.GaussianMixture.from_stddevs, {
            **pairs, 'stddevs': [(1, 1), (2, 2)], 'rho': [0, 0]}),
        'GaussianMixture.affine': (mix.affine, {'matrix': identity}),
        'GaussianMixture.convolve': (mix.convolve, {'kernel': identity}),
        'GaussianMixture.deconvolve': (mix.deconvolve, {
            'covariance': 0.1 * identity}),
        'GaussianMixture.encircled_energy': (mix.encircled_energy, {
            'radius': 2.0}),
        'GaussianMixture.evaluate': (mix.evaluate, steps),
        'GaussianMixture.gradient': (mix.gradient, steps),
        'GaussianMixture.render': (mix.render, {
            'shape': (9, 9), 'x_0': 4, 'y_0': 4, 'flux': 1}),
        'GaussianMixture.shift': (mix.shift, {'offset': (1, 2)}),
        'blend': (mg.blend, {'mixtures': [mix] * 2, 'fractions': [.5, .5]}),
    }


def models():
    mix, psf, place = mixture(), grid(), {'x': 1.0, 'y': 2.0}
    return {
        'MultiGaussianPSFModel': (mg.MultiGaussianPSFModel, {
            'mixture': mix}),
        'MultiGaussianPSFModel of K': (mg.MultiGaussianPSFModel, {
            'n_components': 3}),
        'GriddedMixturePSF': (mg.GriddedMixturePSF, {
            'mixtures': psf.mixtures, 'grid_xypos': psf.grid_xypos,
            'scales': np.ones(4), 'interpolation': 'blend',
            'outside': 'clamp'}),
        'GriddedMixturePSF.convolve': (psf.convolve, {'kernel': np.eye(2)}),
        'GriddedMixturePSF.evaluate': (psf.evaluate, {
            **place, 'flux': 1.0, 'x_0': 1.0, 'y_0': 2.0}),
        'GriddedMixturePSF.local_model': (psf.local_model, place),
        'GriddedMixturePSF.mixture_at': (psf.mixture_at, place),
        'GriddedMixturePSF.scale_at': (psf.scale_at, place),
        'GriddedMixturePSF.render': (psf.render, {
            'x': [1.0], 'y': [2.0], 'flux': [3.0], 'shape': (9, 9)}),
    }


def shapes():
    psf, cut = grid(), stamp()
    result = mg.assess_psf(psf, psf, (3, 3), shape=SHAPE)
    planes = {'planes': np.ones((1, 5, 5)), 'exponents': np.zeros((1, 2)),
              'contexts': ('X_IMAGE', 'Y_IMAGE'), 'zeros': np.zeros(2),
              'scales': np.ones(2), 'sampling': 1.0}
    return {
        'adaptive_moments': (mg.adaptive_moments, {
            **cut, 'oversampling': 1, 'origin': (10, 10)}),
        'assess_psf': (mg.assess_psf, {
            'model': psf, 'truth': psf, 'grid': (3, 3), 'shape': SHAPE}),
        'PSFAssessment.map': (result.map, {'name': 'r2'}),
        'PSFAssessment.median': (result.median, {'name': 'r2'}),
        'PSFExModel': (mg.PSFExModel, planes),
        'fit_mixture': (mg.fit_mixture, {
            **cut, 'n_components': 2, 'oversampling': 1, 'origin': (10, 10),
            'radius': 9, 'normalize': 'free', 'weighting': 'uniform',
            'means': 'free', 'start': None}),
        'fit_mixture in a circle': (mg.fit_mixture, {
            **cut, 'n_components': 2, 'enclosed_flux': 0.98}),
        'compare_n_components': (mg.compare_n_components, {
            **cut, 'n_components': (1, 2)}),
        'select_n_components': (mg.select_n_components, {
            **cut, 'n_components': (1, 2, 3), 'rms_residual': 0.01}),
    }


def fields():
    given = {**pixels(), 'stars': stars(), 'n_components': 2, 'degree': 1,
             'radius': 6}
    field = mg.fit_mixture_field(**given)
    return {
        'fit_mixture_field': (mg.fit_mixture_field, {
            **given, 'effective_gain': 1.0, 'regularization': 1.0,
            'centre': 'core', 'start': None}),
        'EmpiricalPSF.from_stars': (mg.EmpiricalPSF.from_stars, {
            **given, 'oversampling': 2}),
        'MixtureField.mixture_at': (field.mixture_at, {'x': 1.0, 'y': 2.0}),
        'MixtureField.to_grid': (field.to_grid, {'grid_shape': (3, 3)}),
        'select_psf_stars': (mg.select_psf_stars, {
            **pixels(), 'sources': None, 'fwhm': 2.5, 'threshold': 50.0,
            'radius': 6, 'isolation': 5, 'saturation': 1e9, 'min_snr': 50,
            'max_stars': 20}),
    }


def stars_of_images():
    psf, init = grid(), stars('_0')
    surface = QTable({'flux_fit': [1.0], 'flux_err': [0.1]},
                     units=dict.fromkeys(['flux_fit', 'flux_err'],
                                         u.MJy / u.sr))
    return {
        'MixturePSFPhotometry': (
            partial(photometry, mg.MixturePSFPhotometry), {
                **pixels(), 'init_params': init, 'psf_model': psf,
                'fit_shape': (9, 9), 'effective_gain': 1.0,
                'variance': 'model'}),
        'CrowdedMixturePhotometry': (
            partial(photometry, mg.CrowdedMixturePhotometry), {
                **pixels(), 'psf_model': psf, 'threshold': 4.5, 'keep': 2.0,
                'depth': 3.5, 'count_slope': 1.5, 'background_size': 32,
                'psf_error': .01, 'effective_gain': 1.0, 'maxiters': 2,
                'tile_shape': None, 'overlap': 20, 'xy_bounds': 1.0}),
        'inject_and_recover': (mg.inject_and_recover, {
            **pixels(), 'photometry': mg.CrowdedMixturePhotometry(psf),
            'flux': [1e4, 2e4], 'separation': 20, 'radius': .7,
            'flux_ratio': 2.5, 'flux_edges': [5e3, 5e4],
            'effective_gain': 1.0, 'repeats': 1, 'rng': 1}),
        'fit_crowded_psf': (mg.fit_crowded_psf, {
            **pixels(), 'stars': stars(), 'n_components': 1, 'degree': 0,
            'radius': 5, 'max_stars': 20, 'min_snr': 5.0, 'saturation': 1e9,
            'effective_gain': 1.0, 'background_size': 32, 'max_passes': 6,
            'checkpoint': None}),
        'fit_many': (mg.fit_many, {
            'images': [(image(), psf, wcs())], 'coordinates': places(),
            'fit_shape': 11}),
        'add_sky_positions': (mg.add_sky_positions, {
            'table': measured(), 'wcs': wcs()}),
        'to_flux_densities': (mg.to_flux_densities, {
            'table': surface, 'pixel_area': 0.01 * u.arcsec**2}),
        'cramer_rao': (mg.cramer_rao, {
            'psf': psf, 'flux': 1e3, 'sky': 1.0, 'x': 10.0, 'y': 12.0,
            'read_noise': 1.0, 'gain': 1.0, 'exposure_time': 1.0,
            'fit_shape': 9}),
        'pixel_error': (mg.pixel_error, {
            'light': image(), 'sky': 1.0, 'read_noise': 1.0, 'gain': 1.0,
            'exposure_time': 1.0}),
        'pixel_phase_error': (mg.pixel_phase_error, {
            'true': np.linspace(0, 9, 99), 'measured': np.linspace(0, 9, 99),
            'n_bins': 8}),
        'decode_psf_flags': (mg.decode_psf_flags, {'flags': [0, 1]}),
    }


def places():
    return SkyCoord([10.0, 10.0001], [20.0, 20.0001], unit='deg')


def motions_of_stars():
    solution = motions(epochs())
    return {
        'ProperMotionFitter': (motions, {
            'epochs': epochs(), 'transform': 'affine', 'recipe': 'joint',
            'references': None, 'ref_epoch': Time('2021-01-01'),
            'systematic': 'fit', 'match_by': 'auto',
            'match_radius': 1 * u.arcsec, 'max_motion': 50 * u.mas / u.yr,
            'clip': 5.0, 'hold_out': 0.0,
            'parallax_prior': [.5, .5] * u.mas, 'rng': 1}),
        'Epoch': (motions_with, {
            'table': measured(), 'wcs': wcs(), 'time': Time('2020-01-01'),
            'observer': None}),
        'MotionSolution.at': (solution.at, {'time': Time('2022-01-01')}),
        'MotionSolution.bootstrap': (solution.bootstrap, {
            'n_resamples': 20, 'rng': 1}),
        'decode_motion_flags': (mg.decode_motion_flags, {'flags': 1}),
        'bootstrap_median': (mg.bootstrap_median, {
            'values': np.arange(9.0), 'n_resamples': 100, 'rng': 1}),
        'invert_wcs': (mg.invert_wcs, {
            'wcs': wcs(), 'coordinates': places(), 'tolerance': 1e-7,
            'max_iterations': 20}),
        'barycentric_observer': (mg.barycentric_observer, {
            'name': 'earth', 'time': Time('2020-01-01')}),
    }


def pixel_motions(**options):
    images, known = options.pop('images'), options.pop('stars')
    return mg.PixelMotionFitter(**options).fit(images, known)


def motions_of_pixels():
    taken = {**pixels(), 'psf': grid(), 'wcs': wcs(), 'band': 'g',
             'observer': 'l2'}
    return {
        'ImageEpoch': (mg.ImageEpoch, {**taken, 'time': 2020.0}),
        'PixelMotionFitter': (pixel_motions, {
            'images': [mg.ImageEpoch(**taken, time=year)
                       for year in (2020.0, 2021.0)],
            'stars': places(), 'parallax': False, 'acceleration': False,
            'references': None, 'fit_shape': 11, 'fit_sky': True,
            'forced': False, 'progress_bar': False, 'flux': 'image',
            'reach': 0.75, 'refine_frames': False}),
    }


def scenes():
    psf, instrument = grid(), mg.Instrument(shape=SHAPE)
    sky = mg.sky_field(8, 9, size=0.5, rng=1)
    exposures = mg.paper_exposures()[:1]
    many = {'sources': sky, 'exposures': exposures, 'instrument': instrument,
            'psfs': None, 'rng': 1}
    ranges = {'magnitudes': (18.0, 24.0), 'rng': 0}
    return {
        'simulate': (mg.simulate, {
            'sources': mg.sparse_field(SHAPE, spacing=30), 'psf': psf,
            'exposure': None, 'instrument': instrument, 'effects': None,
            'rng': 1}),
        'simulate_epochs': (mg.simulate_epochs, many),
        'simulate_catalogues': (mg.simulate_catalogues, {
            **many, 'threshold': 5.0}),
        'render_stars': (mg.render_stars, {
            'psf': psf, 'x': [1.0, 9.0], 'y': [2.0, 8.0], 'flux': [3.0, 5.0],
            'shape': (16, 16), 'faintest': .001}),
        'sky_field': (mg.sky_field, {
            'n_stars': 5, 'n_qsos': 5, 'ra': 10.0, 'dec': 20.0, 'size': 1.0,
            'separation': 0.0, **ranges}),
        'crowded_field': (mg.crowded_field, {
            'shape': (32, 32), 'density': .01, 'margin': 4, **ranges}),
        'sparse_field': (mg.sparse_field, {
            'shape': SHAPE, 'spacing': 20, 'psf_fraction': .3,
            'psf_magnitudes': (18.0, 20.0), **ranges}),
    }


def instruments():
    return {
        'Band': (mg.Band, {
            'name': 'q', 'wavelengths': (500.0, 510.0), 'efficiency': .5,
            'sky': 22.0, 'diameter': 2.0}),
        'csst_psf': (mg.csst_psf, {
            'shape': SHAPE, 'band': 'g', 'n_nodes': 2, 'variation': 1.0,
            'rng': 24}),
        'DetectorEffects': (mg.DetectorEffects, {
            'prnu': .01, 'hot_pixels': .01, 'dead_pixels': .01,
            'hot_dark': 5.0, 'bad_columns': 1, 'cosmic_rays': 1.0,
            'nonlinearity': 1e-6, 'charge_diffusion': .3,
            'brighter_fatter': 1e-6, 'large_scale_flat': .01,
            'flat_error': .001, 'shutter': 1.0, 'warm_pixels': .01,
            'warm_dark': .3}),
        'Exposure': (mg.Exposure, {
            'time': Time('2026-01-01'), 'band': 'g', 'ra': 10.0, 'dec': 20.0,
            'rotation': 0.0, 'scale': 1.0, 'distortion': None, 'detector': 1,
            'aberration': False}),
        'Instrument': (mg.Instrument, {
            'shape': SHAPE, 'pixel_scale': .07, 'gain': 1.0,
            'read_noise': 5.0, 'dark': .02, 'bias': 500.0, 'full_well': 9e4,
            'exposure_time': 150.0}),
        'paper_exposures': (mg.paper_exposures, {
            'ra': 10.0, 'dec': 20.0, 'offset': 3.0, 'rotation': .05,
            'scale': 1e-4, 'distortion': .5, 'rng': 2}),
        # Without a shape it is a whole detector, which takes minutes.
        'paper_scene': (partial(mg.paper_scene, shape=SHAPE), {
            'field': 'ngp', 'epoch': 3, 'psf': None, 'effects': None,
            'rng': 1}),
    }


PARTS = (mixtures, models, shapes, fields, stars_of_images, motions_of_stars,
         motions_of_pixels, scenes, instruments)


def all_calls():
    """Return (function, keyword arguments) by name."""
    return {name: call for part in PARTS for name, call in part().items()}
