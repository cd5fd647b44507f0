"""What a report says of an exposure among the others of its field."""
from types import SimpleNamespace

import numpy as np

from photutils_mgauss import plotting
from photutils_mgauss.cli.exposure_quality import FieldOfExposures, name_of
from photutils_mgauss.cli.page import Panel, Section, Verdict
from photutils_mgauss.utils.star_columns import column_values

# Pulls in this range say that errors are right; so much may be missing.
_RIGHT, _COMPLETE = (0.8, 1.25), 0.8


def field_sections(folder, paths):
    """
    Return a section for each catalogue that belongs to a field.

    Parameters
    ----------
    folder : path-like
        The output of ``mgauss motions``.
    paths : list of `~pathlib.Path`
        Files, of which some are catalogues of its exposures.

    Raises
    ------
    OSError, ValueError
        If there is no such field, or it has none of them.
    """
    field = FieldOfExposures(folder)
    # A PSF and a catalogue of one exposure may have one name.
    known = [name for name in dict.fromkeys(map(name_of, paths))
             if name in field.names]
    if not known:
        msg = (f'{folder}: --field must be of the catalogues given, but its '
               f'exposures are {", ".join(field.names) or "not known"}')
        raise ValueError(msg)
    figures = field.figures()
    return [_section(field, name, figures[name]) for name in known]


def _section(field, name, figures):
    own = field.rows_of(name)
    rows, known = field.residuals[own], field.references()[own]
    unit = getattr(field.residuals['dra'], 'unit', None) or 'pix'
    facts = {_words(key, unit): f'{value:.3g}'
             for key, value in figures.items()}
    shown = SimpleNamespace(residuals=rows)
    epoch = field.record['pieces'][name][0]
    panels = [Panel(lambda ax: plotting.plot_residual_vectors(
        shown, epoch, title=name, ax=ax),
        'Detections minus the fitted motions of their stars; rejected ones '
        'are orange.')]
    pulls = _pulls(rows[known])
    if pulls.size:
        panels.append(Panel(
            lambda ax: plotting.plot_pulls(pulls, ax=ax),
            'Residuals of references (of all stars, if there are none) in '
            'units of their errors, along both axes; the line is for correct '
            'errors.'))
    return Section(f'{name} in its field: {field.folder}', facts=facts,
                   panels=tuple(panels), verdict=_verdict(figures),
                   text='Completeness: of the stars that two other exposures '
                        'show (or the only other one), the share that this '
                        'exposure shows.')


def _words(name, unit):
    words = name[0].upper() + name[1:]
    return f'{words} [{unit}]' if name == 'systematic error' else words


def _verdict(figures):
    """Judge an exposure by its references and by the stars it shows."""
    pulls = figures.get('pulls of references', 1.0)
    complete = figures.get('completeness', 1.0)
    return Verdict(
        _RIGHT[0] < pulls < _RIGHT[1] and complete > _COMPLETE,
        f'references scatter {pulls:.2f} times as much as their errors say, '
        f'{complete:.0%} of the stars of other exposures are found')


def _pulls(rows):
    """Return residuals in their errors, leverage taken into account."""
    each = np.array([column_values(rows, name)
                     / column_values(rows, f'{name}_error')
                     for name in ('dra', 'ddec')])
    with np.errstate(invalid='ignore', divide='ignore'):
        scale = np.sqrt(column_values(rows, 'chi2') / np.sum(each**2, axis=0))
    pulls = (each * scale).ravel()
    return pulls[np.isfinite(pulls)]
