"""The PSF, its Gaussians, their posterior: Figs. 1-3, Appendices A, B."""
import numpy as np
from astropy.table import QTable
from matplotlib.colors import LogNorm, SymLogNorm
from scenes import detector
from settings import PIXEL, STAMP_RADIUS
from store import Comparison, Figure, Group
from styles import COLOURS, canvas_of

from photutils_mgauss import (
    MixturePosterior,
    compare_n_components,
    fit_mixture,
    sample_mixture,
)
from photutils_mgauss.plotting import (
    plot_ellipses,
    plot_model_graph,
    plot_posterior,
    plot_profile,
    plot_projection,
    plot_trace,
)

FIT = {'oversampling': 2, 'radius': STAMP_RADIUS}
HALF = 15  # of the stamp that is fitted, 31 samples of 0.037 arcsec across
PARAMETERS = ('weights', 'means', 'stddevs', 'rho', 'sigma')


def measure(run):
    """Return the empirical PSF in the middle of detector 8, and its fits."""
    image = run.table('fig1_psf', lambda: _stamp(run))
    stamp = cut(image['sample'])
    return {
        'image': image,
        'components': run.table('fig3_components',
                                lambda: _components(stamp)),
        'numbers': run.table('appendix_b_numbers', lambda: _numbers(stamp))}


def _stamp(run):
    ny, nx = run.settings.shape
    image = detector(run, 8).empirical.image_at((nx - 1) / 2, (ny - 1) / 2)
    detector(run, 8).release()
    return QTable({'sample': image})


def cut(image):
    """Return the inner part of the image of the PSF."""
    image = np.asarray(image)
    c = len(image) // 2
    return image[c - HALF:c + HALF + 1, c - HALF:c + HALF + 1]


def _components(stamp):
    fit = fit_mixture(stamp, 3, **FIT)
    mixture = fit.mixture
    return QTable({
        'weight': mixture.weights, 'x_mean': mixture.means[:, 0],
        'y_mean': mixture.means[:, 1], 'x_stddev': mixture.stddevs[:, 0],
        'y_stddev': mixture.stddevs[:, 1], 'rho': mixture.rho})


def _numbers(stamp):
    table = compare_n_components(stamp, (1, 2, 3, 4, 5), **FIT)
    table['residual'] = [fit.residual / stamp.max()
                         for fit in table.meta['fits']]
    table.meta.clear()
    return table


def enclosed(image, radius):
    """Return the share of an image's flux within a radius [native pix]."""
    steps = (np.arange(len(image)) - len(image) // 2) / 2
    return image[np.hypot(steps, steps[:, None]) <= radius].sum() / image.sum()


def draw_image(tables):
    """Draw Fig. 1: projections of the whole PSF and of the cut one."""
    image = np.asarray(tables['image']['sample'])
    steps = (np.arange(len(image)) - len(image) // 2) / 2
    inner = np.hypot(steps, steps[:, None]) <= STAMP_RADIUS
    canvas = canvas_of(4.6)
    axes = canvas.subplots(2, 2, sharex=True)
    for column, (shown, name) in enumerate((
            (image, 'whole'), (np.where(inner, image, 0), 'within 1.1"'))):
        for row, axis in enumerate('xy'):
            ax = axes[row, column]
            values = shown.sum(axis=row) / image.sum()
            ax.step(steps * PIXEL, np.where(values > 0, values, np.nan),
                    where='mid', color=COLOURS[row])
            top = values.max()
            ax.set(xlabel=f'{axis} [arcsec]', ylabel='share of the flux',
                   title=f'{name}, projected on {axis}', yscale='log',
                   ylim=(top / 1e4, 2 * top))
    return canvas


def compare_image(tables):
    """Compare the flux within 1.1 arcsec."""
    share = enclosed(np.asarray(tables['image']['sample']), STAMP_RADIUS)
    return [Comparison('flux within a circle of 1.1" across, of that in the '
                       'stamp', '98 %', f'{share:.1%}'.replace('%', ' %'))]


def draw_graph(tables):
    """Draw Fig. 2: the Bayesian model, with the letters of the paper."""
    canvas = canvas_of(2.4)
    side = len(cut(tables['image']['sample']))
    ax = plot_model_graph(3, (side, side), ax=canvas.subplots())
    for text in ax.texts:
        name, _, rest = text.get_text().partition('\n')
        if name and name != 'image':
            text.set_text(f'$\\{name}$\n{rest}')
    return canvas


def draw_components(tables):
    """Draw Fig. 3: the profile and its Gaussians, linear and logarithmic."""
    stamp = cut(tables['image']['sample'])
    fit = fit_mixture(stamp, 3, **FIT)
    canvas = canvas_of(6.0)
    axes = canvas.subplots(2, 2)
    for ax, axis in zip(axes[0], 'xy', strict=True):
        plot_projection(fit, stamp, axis=axis, oversampling=2, ax=ax)
        top = ax.get_ylim()[1]
        ax.set(yscale='log', ylim=(top / 1e4, 2 * top))
    plot_profile(fit, stamp, ax=axes[1, 0])
    axes[1, 0].set_ylim(1e-4, 2)
    plot_ellipses(fit.mixture, ax=axes[1, 1])
    axes[0, 0].set_title('(a) projection on x')
    axes[0, 1].set_title('(a) projection on y')
    axes[1, 0].set_title('(b) brightest row')
    axes[1, 1].set_title('the Gaussians, one sigma')
    return canvas


def compare_components(tables):
    """Compare the shares of the Gaussians."""
    weights = np.sort(tables['components']['weight'])[::-1]
    words = ', '.join(f'{100 * w:.0f} %' for w in weights)
    return [Comparison('share of the strongest Gaussian', '80 %',
                       f'{100 * weights[0]:.0f} %'),
            Comparison('shares of all three', '80 %, the others 20 %', words)]


def draw_numbers(tables):
    """Draw Appendix B: residuals for one, three and five Gaussians."""
    stamp = cut(tables['image']['sample'])
    canvas = canvas_of(2.2)
    first, *others = canvas.subplots(1, 4, sharey=True)
    side = (HALF + 0.5) / 2 * PIXEL
    frame = {'origin': 'lower', 'extent': (-side, side, -side, side)}
    # Linear below a thousandth of the peak, so that all residuals are seen.
    faint = {'linthresh': 1e-3, 'base': 10}
    shown = first.imshow(stamp / stamp.max(), norm=LogNorm(1e-4, 1), **frame)
    first.set(title='PSF', xlabel='x [arcsec]', ylabel='y [arcsec]')
    canvas.colorbar(shown, ax=first, location='bottom', label='of the peak',
                    ticks=[1e-4, 1e-2, 1])
    rows = tables['numbers'][np.isin(tables['numbers']['n_components'],
                                     (1, 3, 5))]
    for ax, row in zip(others, rows, strict=True):
        shown = ax.imshow(row['residual'], cmap='RdBu_r', norm=SymLogNorm(
            vmin=-0.1, vmax=0.1, **faint), **frame)
        ax.set(title=f'K = {row["n_components"]}, {1e3 * row["time"]:.0f} ms',
               xlabel='x [arcsec]')
    canvas.colorbar(shown, ax=others, location='bottom', shrink=0.6,
                    label='residual, of the peak', extend='both',
                    ticks=[-0.1, -0.01, -0.001, 0, 0.001, 0.01, 0.1],
                    format='%g')
    return canvas


def compare_numbers(tables):
    """Say what more Gaussians give."""
    rows = {int(row['n_components']): row for row in tables['numbers']}
    lines = [Comparison(
        f'K = {k}: dR2/R2, d-epsilon, largest residual / peak, time',
        {1: 'inadequate', 3: 'chosen', 5: 'may overfit'}[k],
        f'{rows[k]["r2_error"]:+.4f}, {rows[k]["ellipticity_error"]:+.4f}, '
        f'{rows[k]["max_residual"]:.4f}, {1e3 * rows[k]["time"]:.0f} ms')
        for k in (1, 3, 5)]
    better = (abs(rows[5]['r2_error']) < abs(rows[3]['r2_error'])
              and rows[5]['max_residual'] < rows[3]['max_residual'])
    word = ('not seen: K = 5 is closer in size and residual' if better
            else 'seen here, too')
    return [*lines, Comparison('overfitting with K = 5',
                               'size and ellipticity get worse', word)]


def measure_posterior(run):
    """Return the draws of the posterior of the same stamp, and a summary."""
    made = []

    def sample():
        if not made:
            made.append(_sample(run, cut(_known_stamp(run)['sample'])))
        return made[0]
    return {'draws': run.table('appendix_a_draws', lambda: _draws(sample())),
            'summary': run.table('appendix_a_summary',
                                 lambda: sample().summary())}


def _known_stamp(run):
    """Return the image of Fig. 1, measured again if that has another size."""
    path = run.folder / 'tables' / 'fig1_psf.ecsv'
    with run.step('psf'):
        if run.holds(path):
            return QTable.read(path)
    return run.table('appendix_a_psf', lambda: _stamp(run), keep=False)


def _sample(run, stamp):
    draws = run.settings.draws
    return sample_mixture(stamp, 3, prior='paper', pixel_scale=PIXEL,
                          draws=draws, tune=draws, chains=2, cores=1,
                          rng=1, **FIT)


def _draws(posterior):
    """Return every second draw of each chain, one row for each."""
    return QTable({name: np.moveaxis(getattr(posterior, name), 0, 1)[::2]
                   for name in (*PARAMETERS, 'flux')})


def draw_posterior(tables):
    """Draw Appendix A: distributions and traces of the parameters."""
    draws = {name: np.moveaxis(np.asarray(tables['draws'][name]), 0, 1)
             for name in (*PARAMETERS, 'flux')}
    posterior = MixturePosterior(**draws, fit=None, idata=None)
    canvas = canvas_of(9.0)
    for name, (left, right) in zip(PARAMETERS, canvas.subplots(5, 2),
                                   strict=True):
        left.set_prop_cycle(color=COLOURS)
        plot_posterior(posterior, name, ax=left)
        plot_trace(posterior, name, ax=right)
        right.set_xlabel('every second draw')
        left.locator_params(axis='x', nbins=6)
        # Between the panels, where it hides no curve; both have its colours.
        left.legend(loc='upper left', bbox_to_anchor=(1, 1))
        right.get_legend().remove()
    return canvas


def compare_posterior(tables):
    """Say whether the chains agree."""
    worst = float(np.nanmax(tables['summary']['r_hat']))
    return [Comparison('largest r-hat of all parameters', 'not given',
                       f'{worst:.3f}')]


GROUPS = (
    Group('psf', measure, (
        Figure('fig1', 'Fig. 1: the PSF and its cut',
               'The empirical PSF in the middle of detector 8, made of stars '
               'of a simulated exposure by ``EmpiricalPSF``, and the part of '
               'it that is fitted.', draw_image, compare_image),
        Figure('fig2', 'Fig. 2: the Bayesian model',
               'The parameters and their priors as ``sample_mixture`` has '
               'them. The stamp has 31 samples a side, where the paper has '
               '30, so that the star is in the middle of one.', draw_graph),
        Figure('fig3', 'Fig. 3: profile and components',
               'Three Gaussians fitted to that stamp by ``fit_mixture``. '
               'Shares depend on the aberrations: where coma is strong, as '
               'in the middle of this detector, the core takes more than one '
               'Gaussian.',
               draw_components, compare_components),
        Figure('appendix_b', 'Appendix B: the number of Gaussians',
               'Residuals for one, three and five Gaussians, by '
               '``compare_n_components``, from the fits of the table below; '
               'time is that of one least-squares '
               'fit. One Gaussian has the size and ellipticity of the image '
               'by construction, because adaptive moments are those of the '
               'Gaussian that matches it best: what it lacks shows in the '
               'residual only.', draw_numbers, compare_numbers)),
        ('fig1_psf', 'fig3_components', 'appendix_b_numbers')),
    Group('posterior', measure_posterior, (
        Figure('appendix_a', 'Appendix A: the posterior',
               'Draws of ``sample_mixture`` with the priors of the paper: '
               'distributions on the left, traces of two chains on the '
               'right. Lengths are in pixels from the centre of the stamp.',
               draw_posterior, compare_posterior),),
        ('appendix_a_draws', 'appendix_a_summary'), random=False),
)
