"""
All figures, drawn on the Axes they are given or on pyplot's current ones.

One module for each kind of result: `fit` shows a mixture beside the image it
was fitted to, `grid` a PSF over a detector, `field` a field and its stars,
`posterior` the draws of PyMC, `stars` measured stars, and `motions` epochs
and proper motions; `style` has their colours. Every function imports
matplotlib when it is called, takes the numbers it draws as public objects or
tables, computes none itself, takes ``ax=None`` and returns the Axes, and
leaves saving and showing to the caller.
"""
from photutils_mgauss.plotting.field import plot_field
from photutils_mgauss.plotting.fit import (
    plot_comparison_of_numbers,
    plot_ellipses,
    plot_mixture,
    plot_profile,
    plot_projection,
    plot_residual,
)
from photutils_mgauss.plotting.grid import (
    plot_node_map,
    plot_psf_image,
    plot_radial_profile,
    plot_shape_map,
    plot_whiskers,
    plot_width_map,
    plot_worst_node,
)
from photutils_mgauss.plotting.motions import (
    plot_cutouts,
    plot_errors_by_epochs,
    plot_motion_errors,
    plot_motions_by_magnitude,
    plot_proper_motions,
    plot_reference_differences,
    plot_residual_map,
    plot_residual_vectors,
)
from photutils_mgauss.plotting.posterior import (
    plot_corner,
    plot_model_graph,
    plot_posterior,
    plot_trace,
)
from photutils_mgauss.plotting.stars import (
    plot_comparison,
    plot_detections,
    plot_error_curve,
    plot_pulls,
    plot_residual_image,
    plot_stated_errors,
)

__all__ = [
    'plot_comparison',
    'plot_comparison_of_numbers',
    'plot_corner',
    'plot_cutouts',
    'plot_detections',
    'plot_ellipses',
    'plot_error_curve',
    'plot_errors_by_epochs',
    'plot_field',
    'plot_mixture',
    'plot_model_graph',
    'plot_motion_errors',
    'plot_motions_by_magnitude',
    'plot_node_map',
    'plot_posterior',
    'plot_profile',
    'plot_projection',
    'plot_proper_motions',
    'plot_psf_image',
    'plot_pulls',
    'plot_radial_profile',
    'plot_reference_differences',
    'plot_residual',
    'plot_residual_image',
    'plot_residual_map',
    'plot_residual_vectors',
    'plot_shape_map',
    'plot_stated_errors',
    'plot_trace',
    'plot_whiskers',
    'plot_width_map',
    'plot_worst_node',
]
