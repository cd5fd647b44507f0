"""``mgauss motions --pixels --crowded``: motions where stars overlap."""
from photutils_mgauss.cli import photometry, tools

# What only fits of single stars know.
_SINGLE = ('forced', 'refine_frames', 'parallax', 'observer',
           'residual_radius')


def check(options):
    """Raise for what is not known of crowded fields."""
    for name in _SINGLE:
        if getattr(options, name):
            msg = (f'--{name.replace("_", "-")} must be given without '
                   '--pixels --crowded')
            raise ValueError(msg)


def own_psf(options, image):
    """Return the PSF of the image's own stars."""
    with tools.about(image.path):
        return photometry.own_psf(image, options)


def solve(options, epochs, stars, frames):
    """
    Return the table of all stars.

    Parameters
    ----------
    options : `argparse.Namespace`
    epochs : list of ImageEpoch
    stars : `~astropy.table.Table` or None
        Those to report.
    frames : FrameErrors or None
        Those of the frames.
    """
    from photutils_mgauss.crowded.photometry import CrowdedMixturePhotometry
    from photutils_mgauss.pixel_motions.errors import add_frame_errors
    table = CrowdedMixturePhotometry(
        None, threshold=options.threshold or 4.5,
        checkpoint=options.checkpoint).fit_images(epochs, stars,
                                                  motions=True)
    if len(table) == 0:
        msg = 'images must show a star, got none; try --threshold'
        raise ValueError(msg)
    if frames is not None:
        add_frame_errors(table, frames, [one.year for one in epochs])
    return table
