"""Types of the public names, which are loaded on first use."""
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from enum import IntEnum
from os import PathLike
from pathlib import Path
from typing import IO, Any, Literal, Self, Union

from astropy.coordinates import CartesianRepresentation, SkyCoord
from astropy.io.fits import Header
from astropy.modeling import Fittable2DModel, Parameter
from astropy.nddata import NDData
from astropy.table import QTable, Table
from astropy.time import Time
from astropy.units import Quantity, UnitBase
from astropy.wcs.wcsapi import BaseHighLevelWCS, BaseLowLevelWCS
from gwcs import WCS as GWCS
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray
from photutils.psf import GriddedPSFModel, ImagePSF, PSFPhotometry, STDPSFGrid

from photutils_mgauss import plotting as plotting
from photutils_mgauss.psf.contexts import PSFContext
from photutils_mgauss.psf.errors import PSFErrors
from photutils_mgauss.psf.mixture import Moments

__version__: str

class Band:
    name: str
    wavelengths: tuple[float, ...]
    efficiency: float
    sky: float
    diameter: float
    response: tuple[float, ...]
    def __init__(
        self, name: str, wavelengths: tuple[float, float], efficiency: float,
        sky: float, diameter: float = 2.0, *,
        response: tuple[float, ...] = (1.0, 1.0),
    ) -> None: ...
    def colours(self, n: int) -> NDArray[Any]: ...
    def magnitude(self, rate: ArrayLike) -> float | NDArray[Any]: ...
    @property
    def pivot(self) -> float: ...
    def rate(self, magnitude: ArrayLike) -> float | NDArray[Any]: ...
    @property
    def zeropoint(self) -> float: ...

class CramerRao:
    covariance: NDArray[Any]
    unit: UnitBase | None
    def __init__(
        self, covariance: NDArray[Any], unit: UnitBase | None = None,
    ) -> None: ...
    @property
    def flux_err(self) -> NDArray[Any]: ...
    @property
    def x_err(self) -> NDArray[Any]: ...
    @property
    def y_err(self) -> NDArray[Any]: ...

class CrowdedMixturePhotometry:
    results: QTable
    field: MixtureField | None
    psf_used: Union[GriddedMixturePSF, MultiGaussianPSFModel]
    def __init__(
        self, psf_model: Union[GriddedMixturePSF, MultiGaussianPSFModel, None],
        *, threshold: float = 4.5, keep: float = 2.0, depth: float = 3.5,
        count_slope: float = 1.5, background_size: float | None = 64,
        psf_error: float = 0.01, effective_gain: float | None = None,
        maxiters: int = 3, tile_shape: int | tuple[int, int] | None = None,
        overlap: int = 128, executor: Executor | None = None,
        progress_bar: bool = False, find_neighbors: bool = True,
        xy_bounds: float | None = 1.0,
        checkpoint: str | PathLike[str] | None = None, psf_errors: bool = True,
        confusion: bool = True, correlated_noise: bool = True,
        saturation: float | Quantity | None = None,
        residual_radius: float | None = None, **elsewhere: Any,
    ) -> None: ...
    def __call__(
        self, data: ArrayLike | NDData, *, mask: ArrayLike | None = None,
        error: float | ArrayLike | None = None,
        init_params: Table | None = None,
    ) -> QTable: ...
    def decode_flags(
        self, *, return_bit_values: bool = False,
    ) -> list[list[str]]: ...
    def fit_field(
        self, image: Any, options: Any,
    ) -> Union[MixtureField, GriddedMixturePSF]: ...
    def fit_images(
        self, images: Sequence[Any], stars: Table | SkyCoord | None = None, *,
        motions: bool = False,
    ) -> QTable: ...
    def make_model_image(
        self, shape: tuple[int, int], *,
        psf_shape: int | tuple[int, int] | None = None,
        include_local_bkg: bool = False,
    ) -> NDArray[Any] | Quantity: ...
    def make_residual_image(
        self, data: ArrayLike | NDData, *,
        psf_shape: tuple[int, int] | None = None,
        include_local_bkg: bool = False,
    ) -> NDArray[Any] | Quantity: ...

class DetectorEffects:
    prnu: float
    hot_pixels: float
    dead_pixels: float
    hot_dark: float
    bad_columns: int
    cosmic_rays: float
    nonlinearity: float
    bleeding: bool
    charge_diffusion: float
    brighter_fatter: float
    large_scale_flat: float
    flat_error: float
    shutter: float
    warm_pixels: float
    warm_dark: float
    def __init__(
        self, prnu: float = 0.0, hot_pixels: float = 0.0,
        dead_pixels: float = 0.0, hot_dark: float = 5.0, bad_columns: int = 0,
        cosmic_rays: float = 0.0, nonlinearity: float = 0.0,
        bleeding: bool = False, charge_diffusion: float = 0.0,
        brighter_fatter: float = 0.0, large_scale_flat: float = 0.0,
        flat_error: float = 0.0, shutter: float = 0.0,
        warm_pixels: float = 0.0, warm_dark: float = 0.3,
    ) -> None: ...
    @classmethod
    def typical(cls) -> Self: ...

class EmpiricalPSF:
    field: MixtureField
    coefficients: NDArray[Any]
    degree: int
    oversampling: int
    def __init__(
        self, field: MixtureField, coefficients: NDArray[Any], degree: int,
        oversampling: int,
    ) -> None: ...
    @classmethod
    def from_stars(
        cls, data: ArrayLike | NDData, stars: Table, *,
        error: ArrayLike | None = None, mask: ArrayLike | None = None,
        degree: int = 3, oversampling: int = 2, radius: float = 10,
        n_components: int = 5, executor: Executor | None = None,
    ) -> Self: ...
    def image_at(
        self, x: float, y: float, *, oversampling: int | None = None,
    ) -> NDArray[Any]: ...
    def to_gridded_psf(
        self, grid_shape: int | tuple[int, int] = (30, 30), *,
        oversampling: int | None = None,
    ) -> GriddedPSFModel: ...

class Epoch:
    table: Table
    wcs: BaseLowLevelWCS | BaseHighLevelWCS | None
    time: Time | float | None
    observer: str | CartesianRepresentation | None
    pixel_scale: Quantity | None
    chips: dict[str, Any] | None
    def __init__(
        self, table: Table,
        wcs: BaseLowLevelWCS | BaseHighLevelWCS | None = None,
        time: Time | float | None = None, *,
        observer: str | CartesianRepresentation | None = None,
        pixel_scale: Quantity | None = None,
        chips: dict[str, Any] | None = None,
    ) -> None: ...
    @property
    def column_unit(self) -> UnitBase: ...
    @property
    def is_pixels(self) -> bool: ...
    @property
    def is_scan(self) -> bool: ...
    @property
    def is_sky(self) -> bool: ...
    @property
    def mean_year(self) -> float: ...
    @classmethod
    def of_chips(
        cls, pairs: Sequence[tuple[Table, Any]],
        time: Time | float | None = None, *,
        observer: str | CartesianRepresentation | None = None,
        names: Sequence[Any] | None = None,
    ) -> Self: ...
    @property
    def pixel_size(self) -> float | None: ...
    @property
    def plane_unit(self) -> str: ...
    def with_wcs(
        self, wcs: BaseLowLevelWCS | BaseHighLevelWCS | None,
    ) -> Epoch: ...
    @property
    def years(self) -> float | NDArray[Any]: ...

class Exposure:
    time: Time | str
    band: str | Band
    ra: float
    dec: float
    rotation: float
    scale: float
    distortion: ArrayLike | None
    detector: int
    aberration: bool
    def __init__(
        self, time: Time | str = '2026-05-30T17:27:18', band: str | Band = 'g',
        ra: float = 192.8595, dec: float = 27.1283, *, rotation: float = 0.0,
        scale: float = 1.0, distortion: ArrayLike | None = None,
        detector: int = 1, aberration: bool = False,
    ) -> None: ...
    def fits_header(
        self, shape: tuple[float, ...], pixel_scale: tuple[float, ...],
    ) -> Header: ...
    def pixels(
        self, sources: QTable, shape: tuple[float, ...],
        pixel_scale: tuple[float, ...],
    ) -> NDArray[Any]: ...
    def wcs(self, shape: tuple[int, int], pixel_scale: float) -> GWCS: ...

class FitStatus(IntEnum):
    CONVERGED = 0
    STOPPED = 1
    VANISHED = 2
    AT_LIMIT = 3
    EMPTY = 4
    NOT_FINITE = 5
    TOO_FEW_PIXELS = 6
    NO_STAR = 7
    @property
    def sentence(self) -> str: ...
    @property
    def usable(self) -> bool: ...

class GaussianMixture:
    weights: ArrayLike
    means: ArrayLike
    covariances: ArrayLike
    def __init__(
        self, weights: ArrayLike, means: ArrayLike, covariances: ArrayLike,
    ) -> None: ...
    def affine(self, matrix: ArrayLike) -> GaussianMixture: ...
    def convolve(
        self, kernel: ArrayLike | GaussianMixture,
    ) -> GaussianMixture: ...
    def deconvolve(self, covariance: ArrayLike) -> GaussianMixture: ...
    def encircled_energy(self, radius: ArrayLike) -> float | NDArray[Any]: ...
    def evaluate(
        self, x: ArrayLike, y: ArrayLike, *, pixel_integrated: bool = False,
    ) -> float | NDArray[Any]: ...
    @classmethod
    def from_stddevs(
        cls, weights: ArrayLike, means: ArrayLike, stddevs: ArrayLike,
        rho: float | ArrayLike = 0,
    ) -> Self: ...
    @property
    def fwhm(self) -> float: ...
    def gradient(
        self, x: ArrayLike, y: ArrayLike, *, pixel_integrated: bool = False,
    ) -> NDArray[Any]: ...
    def moments(self) -> Moments: ...
    @property
    def n_components(self) -> int: ...
    def plot(
        self, *, radius: float | None = None, pixel_integrated: bool = False,
        ax: Axes | None = None,
    ) -> Axes: ...
    read: Callable[..., Any]
    def render(
        self, shape: int | tuple[int, int], x_0: float, y_0: float, *,
        flux: float = 1, pixel_integrated: bool = False,
    ) -> NDArray[Any]: ...
    @property
    def rho(self) -> NDArray[Any]: ...
    @property
    def rows(self) -> NDArray[Any]: ...
    def shift(self, offset: ArrayLike) -> GaussianMixture: ...
    @property
    def stddevs(self) -> NDArray[Any]: ...
    write: Callable[..., Any]

class GriddedMixturePSF(Fittable2DModel):
    def __init__(
        self, mixtures: Sequence[GaussianMixture], grid_xypos: ArrayLike, *,
        flux: float | Quantity = 1, x_0: float = 0, y_0: float = 0,
        pixel_integrated: bool = False, scales: ArrayLike | None = None,
        interpolation: Literal['blend', 'components'] = 'blend',
        outside: Literal['clamp', 'raise', 'nan'] = 'clamp',
        errors: PSFErrors | None = None, contexts: Sequence[PSFContext] = (),
        **kwargs: Any,
    ) -> None: ...
    def at_context(self, **values: Any) -> GriddedMixturePSF: ...
    @property
    def contexts(self) -> tuple[PSFContext, ...]: ...
    def convolve(
        self, kernel: ArrayLike | GaussianMixture,
    ) -> GriddedMixturePSF: ...
    def copy(self) -> Self: ...
    def deepcopy(self) -> Self: ...
    @property
    def errors(self) -> PSFErrors | None: ...
    def evaluate(
        self, x: ArrayLike, y: ArrayLike, flux: float | ArrayLike,
        x_0: float | ArrayLike, y_0: float | ArrayLike,
    ) -> NDArray[Any]: ...
    def fit_deriv(
        self, x: ArrayLike, y: ArrayLike, flux: float, x_0: float, y_0: float,
    ) -> list[NDArray[Any]]: ...
    flux: Parameter
    @classmethod
    def from_field(
        cls, field: MixtureField | dict[str, MixtureField], *,
        grid_shape: int | tuple[int, int] = (30, 30),
    ) -> Union[GriddedMixturePSF, dict[str, GriddedMixturePSF]]: ...
    @classmethod
    def from_file(
        cls, path: str | PathLike[str], n_components: int | None = None, *,
        ext: int | str | tuple[str, int] | None = None,
        detector: int | str | None = None, oversampling: int | None = None,
        grid_shape: int | tuple[int, int] = (30, 30), **kwargs: Any,
    ) -> Union[GriddedMixturePSF, dict[str, GriddedMixturePSF]]: ...
    @classmethod
    def from_gridded_psf(
        cls, psf: Union[GriddedPSFModel, STDPSFGrid],
        n_components: int | None = None, *, radius: float | None = None,
        executor: Executor | None = None, progress_bar: bool = False,
        checkpoint: str | PathLike[str] | None = None, **kwargs: Any,
    ) -> Union[GriddedMixturePSF, dict[str, GriddedMixturePSF]]: ...
    @classmethod
    def from_image_psf(
        cls, psf: Union[ImagePSF, Sequence[Any]],
        n_components: int | None = None, *,
        grid_xypos: ArrayLike | None = None, **kwargs: Any,
    ) -> Self: ...
    @classmethod
    def from_psfex(
        cls, path: str | PathLike[str] | PSFExModel | dict[str, Any],
        n_components: int | None = None, *,
        ext: int | str | tuple[str, int] | None = None,
        grid_shape: int | tuple[int, int] = (30, 30),
        limits: tuple[tuple[float, float], tuple[float, float]] | None = None,
        contexts: dict[str, Any] | None = None, **kwargs: Any,
    ) -> Union[GriddedMixturePSF, dict[str, GriddedMixturePSF]]: ...
    @property
    def grid(self) -> Any: ...
    @property
    def grid_shape(self) -> tuple[int, int]: ...
    @property
    def grid_xypos(self) -> NDArray[Any]: ...
    @property
    def has_fixed_shape(self) -> bool: ...
    @property
    def input_units(self) -> dict[str, Any] | None: ...
    @property
    def interpolation(self) -> str: ...
    def local_model(self, x: float, y: float) -> MultiGaussianPSFModel: ...
    def mixture_at(self, x: float, y: float) -> GaussianMixture: ...
    @property
    def mixtures(self) -> list[GaussianMixture]: ...
    @property
    def n_components(self) -> int: ...
    @property
    def outside(self) -> str: ...
    @property
    def pixel_integrated(self) -> bool: ...
    def plot(
        self, quantity: str = 'size', *, ax: Axes | None = None,
    ) -> Axes: ...
    def plot_grid(self, **kwargs: Any) -> Figure: ...
    read: Callable[..., Any]
    def render(
        self, x: ArrayLike, y: ArrayLike, flux: ArrayLike,
        shape: int | tuple[int, int],
    ) -> NDArray[Any]: ...
    @property
    def report(self) -> QTable: ...
    def scale_at(self, x: float, y: float) -> float: ...
    @property
    def scales(self) -> NDArray[Any]: ...
    def to_galsim(self, x: float, y: float) -> Any: ...
    def to_gridded_psf(
        self, oversampling: int = 4, *, radius: float | None = None,
    ) -> GriddedPSFModel: ...
    write: Callable[..., Any]
    x_0: Parameter
    y_0: Parameter

class ImageEpoch:
    data: ArrayLike | NDData
    psf: Union[GriddedMixturePSF, MultiGaussianPSFModel, MixtureField]
    wcs: BaseLowLevelWCS | BaseHighLevelWCS
    time: Time | float
    error: ArrayLike | None
    mask: ArrayLike | None
    band: str | None
    observer: str | CartesianRepresentation | None
    def __init__(
        self, data: ArrayLike | NDData,
        psf: Union[GriddedMixturePSF, MultiGaussianPSFModel, MixtureField],
        wcs: BaseLowLevelWCS | BaseHighLevelWCS, time: Time | float, *,
        error: ArrayLike | None = None, mask: ArrayLike | None = None,
        band: str | None = None,
        observer: str | CartesianRepresentation | None = None,
    ) -> None: ...
    @property
    def model(self) -> Union[GriddedMixturePSF, MultiGaussianPSFModel]: ...
    @property
    def pixels(self) -> Any: ...
    @property
    def velocity(self) -> NDArray[Any] | None: ...
    @property
    def year(self) -> float: ...

class InjectionResult:
    stars: QTable
    curves: QTable
    def __init__(self, stars: QTable, curves: QTable) -> None: ...

class Instrument:
    shape: tuple[int, int]
    pixel_scale: float
    gain: float
    read_noise: float
    dark: float
    bias: float
    full_well: float
    exposure_time: float
    def __init__(
        self, shape: tuple[int, int] = (9232, 9216),
        pixel_scale: float = 0.074, gain: float = 1.1, read_noise: float = 5.0,
        dark: float = 0.02, bias: float = 500.0, full_well: float = 90000.0,
        exposure_time: float = 150.0,
    ) -> None: ...
    @property
    def dark_level(self) -> float: ...
    @property
    def readout_variance(self) -> float: ...
    def sky(self, band: Band) -> float: ...

class MixtureField:
    coefficients: NDArray[Any]
    shape: tuple[int, int]
    radius: float
    covariance: NDArray[Any]
    stars: QTable
    residual_stars: NDArray[Any] | None
    accuracy: float
    dropped: QTable | None
    choice: QTable | None
    exposures: QTable | None
    centre_stddev: float
    pixel_integrated: bool
    unmodelled: NDArray[Any] | None
    wing_share: float
    wing_error: float
    wing_stddev: float
    contexts: QTable | None
    context_coefficients: NDArray[Any] | None
    lateral_shifts: NDArray[Any] | None
    brighter_fatter: QTable | None
    def __init__(
        self, coefficients: NDArray[Any], shape: tuple[int, int],
        radius: float, covariance: NDArray[Any], stars: QTable,
        residual_stars: NDArray[Any] | None = None, accuracy: float = 0.0,
        dropped: QTable | None = None, choice: QTable | None = None,
        exposures: QTable | None = None, centre_stddev: float = ...,
        pixel_integrated: bool = False, unmodelled: NDArray[Any] | None = None,
        wing_share: float = 0.0, wing_error: float = 0.0,
        wing_stddev: float = 0.0, contexts: QTable | None = None,
        context_coefficients: NDArray[Any] | None = None,
        lateral_shifts: NDArray[Any] | None = None,
        brighter_fatter: QTable | None = None,
    ) -> None: ...
    def aperture_correction(
        self, radius: float, x: float, y: float,
    ) -> float: ...
    def aperture_correction_error(
        self, radius: float, x: float, y: float,
    ) -> float: ...
    def at_exposure(self, exposure: int) -> MixtureField: ...
    @property
    def centre(self) -> str: ...
    @property
    def degree(self) -> int: ...
    def enclosed_flux(self, x: float, y: float) -> float: ...
    def mixture_at(
        self, x: float, y: float, *, exposure: int | None = None,
        flux: float | None = None, **contexts: Any,
    ) -> GaussianMixture: ...
    @property
    def n_components(self) -> int: ...
    def plot(
        self, quantity: Literal['size', 'ellipticity', 'residual'] = 'size', *,
        n: int = 20, ax: Axes | None = None,
    ) -> Axes: ...
    def psf_errors(
        self, *, exposure: int | None = None, flux: float | None = None,
        **contexts: Any,
    ) -> PSFErrors: ...
    read: Callable[..., Any]
    def to_grid(
        self, grid_shape: int | tuple[int, int] = (30, 30), *,
        exposure: int | None = None, flux: float | None = None,
        **contexts: Any,
    ) -> GriddedMixturePSF: ...
    write: Callable[..., Any]

class MixtureFit:
    mixture: GaussianMixture | None
    status: FitStatus
    message: str
    flux: float | Quantity
    chi2: float
    bic: float
    enclosed_flux: float
    residual: NDArray[Any] | Quantity
    covariance: NDArray[Any]
    used: NDArray[Any]
    def __init__(
        self, mixture: GaussianMixture | None, status: FitStatus, message: str,
        flux: float | Quantity, chi2: float, bic: float, enclosed_flux: float,
        residual: NDArray[Any] | Quantity, covariance: NDArray[Any],
        used: NDArray[Any],
    ) -> None: ...
    def plot(self, *, ax: Axes | None = None) -> Axes: ...

class MixtureFitter:
    fit_info: dict[str, Any]
    def __init__(self) -> None: ...
    def __call__(
        self, model: Fittable2DModel, x: ArrayLike, y: ArrayLike, z: ArrayLike,
        weights: ArrayLike | None = None, *, maxiter: int | None = 100,
        inplace: bool = False,
    ) -> Fittable2DModel: ...

class MixturePosterior:
    weights: NDArray[Any]
    means: NDArray[Any]
    stddevs: NDArray[Any]
    rho: NDArray[Any]
    flux: NDArray[Any]
    sigma: NDArray[Any]
    fit: MixtureFit
    idata: Any
    def __init__(
        self, weights: NDArray[Any], means: NDArray[Any],
        stddevs: NDArray[Any], rho: NDArray[Any], flux: NDArray[Any],
        sigma: NDArray[Any], fit: MixtureFit, idata: Any,
    ) -> None: ...
    def draws(self, n: int) -> list[GaussianMixture]: ...
    @property
    def mixture(self) -> GaussianMixture: ...
    def parameters(self) -> dict[str, NDArray[Any]]: ...
    def plot(
        self, names: Sequence[str] | None = None, *, axes: Any = None,
    ) -> NDArray[Any]: ...
    def summary(self) -> QTable: ...

class MixturePSFPhotometry(PSFPhotometry):
    results: QTable
    init_params: QTable
    def __init__(
        self,
        psf_model: Union[
            GriddedMixturePSF, MultiGaussianPSFModel, MixtureField,
        ],
        fit_shape: int | tuple[int, int], *, fitter: Any = None,
        executor: Executor | None = None, n_threads: int | None = None,
        fit_sky: bool = False, effective_gain: float | None = None,
        variance: Literal['model', 'data'] = 'model', xy_cov: bool = False,
        psf_errors: bool = True, correlated_noise: bool = True,
        aperture_radius_correction: float | None = None,
        saturation: float | Quantity | None = None,
        residual_radius: float | None = None, **kwargs: Any,
    ) -> None: ...
    def __call__(
        self, data: ArrayLike | NDData, *, mask: ArrayLike | None = None,
        error: float | ArrayLike | None = None,
        init_params: Table | None = None,
    ) -> QTable | None: ...
    @property
    def fit_info(self) -> list[dict[str, Any]]: ...
    @staticmethod
    def fit_many(
        images: Sequence[Any], coordinates: SkyCoord, **kwargs: Any,
    ) -> QTable: ...

class MotionSolution:
    stars: QTable
    epochs: list[Epoch]
    alignment: QTable
    notes: tuple[str, ...]
    def at(self, time: Time | float) -> QTable: ...
    def bootstrap(
        self, n_resamples: int = 10000, *, rng: Generator | int | None = None,
    ) -> Any: ...
    def covariance(self, ids: ArrayLike) -> NDArray[Any]: ...
    def detector_residuals(self) -> QTable: ...
    def mean(self, ids: ArrayLike | None = None) -> QTable: ...
    def measured(self) -> QTable: ...
    def membership(self, *, n_field: int = 1) -> QTable: ...
    def accelerations(self) -> QTable: ...
    def plot(self, *, ax: Axes | None = None) -> Axes: ...
    def plot_residuals(
        self, epoch: int, *, ax: Axes | None = None,
    ) -> Axes: ...
    def reference_differences(self) -> QTable: ...
    @property
    def residuals(self) -> QTable: ...
    @property
    def sky(self) -> SkyCoord | None: ...
    @property
    def terms(self) -> QTable: ...
    def validation(self) -> QTable: ...

class MultiGaussianPSFModel(Fittable2DModel):
    def __init__(
        self, mixture: GaussianMixture | None = None, *, n_components: int = 3,
        flux: float | Quantity = 1, x_0: float = 0, y_0: float = 0,
        pixel_integrated: bool = False, **kwargs: Any,
    ) -> None: ...
    def __call__(
        self, x: ArrayLike, y: ArrayLike, **kwargs: Any,
    ) -> NDArray[Any]: ...
    def convolve(
        self, kernel: ArrayLike | GaussianMixture,
    ) -> MultiGaussianPSFModel: ...
    def copy(self) -> Self: ...
    def deepcopy(self) -> Self: ...
    def evaluate(
        self, x: ArrayLike, y: ArrayLike, flux: float | ArrayLike,
        x_0: float | ArrayLike, y_0: float | ArrayLike, *shape: Any,
    ) -> NDArray[Any]: ...
    def fit_deriv(
        self, x: ArrayLike, y: ArrayLike, flux: float, x_0: float, y_0: float,
        *shape: Any,
    ) -> list[NDArray[Any]]: ...
    flux: Parameter
    def free_shape(self) -> MultiGaussianPSFModel: ...
    @property
    def fwhm(self) -> float: ...
    @property
    def grid(self) -> Any: ...
    @property
    def has_fixed_shape(self) -> bool: ...
    @property
    def input_units(self) -> dict[str, Any] | None: ...
    @property
    def mixture(self) -> GaussianMixture: ...
    @property
    def n_components(self) -> int: ...
    @property
    def pixel_integrated(self) -> bool: ...
    read: Callable[..., Any]
    @property
    def weights(self) -> NDArray[Any]: ...
    write: Callable[..., Any]
    x_0: Parameter
    y_0: Parameter

class Optics:
    shape: int | tuple[int, int]
    band: str | Band
    wavefront: float
    variation: float
    jitter: float
    diffusion: float
    n_wavelengths: int
    pixel_scale: float
    rng: int | Generator
    def __init__(
        self, shape: int | tuple[int, int], band: str | Band = 'g', *,
        wavefront: float = 24.0, variation: float = 12.0, jitter: float = 0.03,
        diffusion: float = 0.026, n_wavelengths: int = 4,
        pixel_scale: float = 0.074, rng: int | Generator = 24,
    ) -> None: ...
    def aberrations(self, x: float, y: float) -> NDArray[Any]: ...
    def light(
        self, x: float, y: float, *, oversampling: int = 4, radius: int = 24,
    ) -> NDArray[Any]: ...
    def profile(self, x: float, y: float) -> Any: ...
    def to_gridded_psf(
        self, n_nodes: int = 21, *, n_samples: int = 10, oversampling: int = 4,
        radius: int = 32,
    ) -> GriddedPSFModel: ...

class PixelMotionFitter:
    def __init__(
        self, *, parallax: bool = False, acceleration: bool = False,
        references: MotionSolution | None = None,
        fit_shape: int | tuple[int, int] = 11, fit_sky: bool = True,
        forced: bool = False, executor: Executor | None = None,
        progress_bar: bool = False,
        flux: Literal['image', 'band', 'common'] = 'image',
        reach: float = 0.75, refine_frames: bool = False,
    ) -> None: ...
    def find(
        self, images: Sequence[ImageEpoch],
        stars: Table | SkyCoord | None = None, *,
        max_motion: Quantity | None = None,
        max_parallax: Quantity | None = None, false_alarm: float = 1e-05,
    ) -> QTable: ...
    def fit(
        self, images: Sequence[ImageEpoch],
        stars: Table | SkyCoord | None = None,
    ) -> PixelMotionSolution: ...

class PixelMotionSolution:
    stars: QTable
    images: QTable
    notes: tuple[str, ...]
    def cutouts(
        self, star: Any = None, *, size: int | tuple[int, int] = 15,
    ) -> QTable: ...
    @property
    def fluxes(self) -> QTable: ...
    def model(self, image: int) -> NDArray[Any]: ...
    def plot(self, *, ax: Axes | None = None) -> Axes: ...
    @property
    def sky(self) -> SkyCoord | None: ...
    @property
    def wcs(self) -> list[Any]: ...

class PixelPhaseError:
    phase: NDArray[Any]
    median: NDArray[Any]
    error: NDArray[Any]
    def __init__(
        self, phase: NDArray[Any], median: NDArray[Any], error: NDArray[Any],
    ) -> None: ...
    @property
    def half_range(self) -> Quantity | float: ...
    def plot(self, *, ax: Axes | None = None) -> Axes: ...

class ProperMotionFitter:
    def __init__(
        self, *, transform: str | None = 'affine',
        parallax: bool | Literal['prior'] = False,
        recipe: Literal['joint', 'two-step', 'paper'] = 'joint',
        references: Table | Sequence[Any] | str | None = None,
        ref_epoch: Time | float | None = None,
        systematic: Literal['fit', 'magnitude'] | Quantity | None = 'fit',
        executor: Executor | None = None,
        match_by: Literal['auto', 'id', 'sky', 'pattern'] = 'auto',
        match_radius: Quantity | None = None, max_motion: Quantity = ...,
        clip: float | None = 5.0, hold_out: float = 0.0,
        parallax_prior: Quantity = ..., acceleration: bool = False,
        eps_t: Literal['printed', 'corrected'] = 'printed',
        rng: Generator | int | None = None, distortion: str | None = 'affine',
        distortion_prior: Quantity = ..., terms: str | Sequence[str] = (),
    ) -> None: ...
    def fit(self, epochs: Sequence[Epoch]) -> MotionSolution: ...

class PSFAssessment:
    table: QTable
    grid_shape: tuple[int, int]
    def __init__(self, table: QTable, grid_shape: tuple[int, int]) -> None: ...
    def map(self, name: str) -> NDArray[Any]: ...
    def median(self, name: str) -> float: ...
    def scatter(self, name: str) -> float: ...

class PSFExModel:
    planes: NDArray[Any]
    exponents: NDArray[Any]
    contexts: tuple[str, ...]
    zeros: NDArray[Any]
    scales: NDArray[Any]
    sampling: float
    def __init__(
        self, planes: NDArray[Any], exponents: NDArray[Any],
        contexts: tuple[str, ...], zeros: NDArray[Any], scales: NDArray[Any],
        sampling: float,
    ) -> None: ...
    def image_at(
        self, x: float, y: float, **contexts: Any,
    ) -> NDArray[Any]: ...
    @property
    def origin(self) -> tuple[float, float]: ...
    @property
    def position_range(self) -> tuple[tuple[float, float], ...]: ...

class Scene:
    image: NDArray[Any]
    error: NDArray[Any]
    flags: NDArray[Any]
    truth: QTable
    psf: Union[GriddedMixturePSF, GriddedPSFModel]
    background: float
    exposure: Exposure
    instrument: Instrument
    wcs: GWCS
    def __init__(
        self, image: NDArray[Any], error: NDArray[Any], flags: NDArray[Any],
        truth: QTable, psf: Union[GriddedMixturePSF, GriddedPSFModel],
        background: float, exposure: Exposure, instrument: Instrument,
        wcs: GWCS,
    ) -> None: ...
    @property
    def mask(self) -> NDArray[Any]: ...
    @property
    def time(self) -> Time: ...
    def to_nddata(self) -> NDData: ...
    def write(
        self, path: str | Path, *,
        layout: Literal['extensions', 'csst'] = 'extensions',
        overwrite: bool = False,
    ) -> list[Path]: ...

class Shapes:
    r2: float | NDArray[Any]
    e1: float | NDArray[Any]
    e2: float | NDArray[Any]
    x: float | NDArray[Any]
    y: float | NDArray[Any]
    flux: float | NDArray[Any]
    r2_err: float | NDArray[Any]
    e1_err: float | NDArray[Any]
    e2_err: float | NDArray[Any]
    x_err: float | NDArray[Any]
    y_err: float | NDArray[Any]
    status: int | NDArray[Any]
    def __init__(
        self, r2: float | NDArray[Any], e1: float | NDArray[Any],
        e2: float | NDArray[Any], x: float | NDArray[Any],
        y: float | NDArray[Any], flux: float | NDArray[Any],
        r2_err: float | NDArray[Any], e1_err: float | NDArray[Any],
        e2_err: float | NDArray[Any], x_err: float | NDArray[Any],
        y_err: float | NDArray[Any], status: int | NDArray[Any],
    ) -> None: ...
    @property
    def ellipticity(self) -> float | NDArray[Any]: ...
    def ellipticity_error(self, model: Shapes) -> float | NDArray[Any]: ...
    @property
    def fwhm(self) -> float | NDArray[Any]: ...
    @property
    def message(self) -> str | list[str]: ...
    def relative_size_error(self, model: Shapes) -> float | NDArray[Any]: ...

class ShapeStatus(IntEnum):
    CONVERGED = 0
    STOPPED = 1
    EMPTY = 2
    DIVERGED = 3
    NOT_FINITE = 4
    @property
    def sentence(self) -> str: ...

class SimulatedCatalogue:
    table: QTable
    truth: QTable
    wcs: GWCS
    time: Time
    def __init__(
        self, table: QTable, truth: QTable, wcs: GWCS, time: Time,
    ) -> None: ...

class TunedMixtureField:
    start: GriddedMixturePSF
    coefficients: NDArray[Any]
    shape: Any
    radius: Any
    covariance: NDArray[Any]
    stars: Any
    residual_stars: Any | None
    accuracy: Any
    dropped: Any | None
    centre_stddev: Any
    pixel_integrated: Any
    unmodelled: NDArray[Any] | None
    def __init__(
        self, start: GriddedMixturePSF, coefficients: NDArray[Any],
        shape: tuple[int, int], radius: float, covariance: NDArray[Any],
        stars: Table, residual_stars: NDArray[Any] | None = None,
        accuracy: float = 0.0, dropped: QTable | None = None,
        centre_stddev: float = ..., pixel_integrated: bool = False,
        unmodelled: NDArray[Any] | None = None,
    ) -> None: ...
    def aperture_correction(
        self, radius: float, x: float, y: float,
    ) -> float: ...
    @property
    def centre(self) -> str: ...
    def changes_at(self, x: float, y: float) -> NDArray[Any]: ...
    def convolution_at(self, x: float, y: float) -> NDArray[Any]: ...
    @property
    def degree(self) -> int: ...
    def enclosed_flux(self, x: float, y: float) -> float: ...
    def mixture_at(self, x: float, y: float) -> GaussianMixture: ...
    def plot(
        self, quantity: Literal['size', 'ellipticity', 'residual'] = 'size', *,
        n: int = 20, ax: Axes | None = None,
    ) -> Axes: ...
    def psf_errors(self) -> PSFErrors: ...
    def to_grid(
        self, grid_shape: int | tuple[int, int] | None = None,
    ) -> GriddedMixturePSF: ...

class UnfinishedTilesError(RuntimeError):
    def __init__(
        self, unfinished: list[tuple[int, int, int, int]], table: QTable,
    ) -> None: ...

CSST_BANDS: dict[str, Band]

def adaptive_moments(
    image: ArrayLike | NDData | GaussianMixture | Sequence[Any], *,
    oversampling: int | tuple[int, int] = 1, origin: ArrayLike | None = None,
    error: float | ArrayLike | None = None, mask: ArrayLike | None = None,
    executor: Executor | None = None,
) -> Shapes: ...

def add_sky_positions(
    table: QTable, wcs: BaseLowLevelWCS | BaseHighLevelWCS,
) -> QTable: ...

def assess_psf(
    model: Union[MixtureField, GriddedMixturePSF, Callable[..., Any]],
    truth: Union[MixtureField, GriddedMixturePSF, Callable[..., Any]],
    grid: tuple[int, int] = (30, 30), *, shape: tuple[int, int] | None = None,
    oversampling: int = 1, mid_cell: bool = False,
) -> PSFAssessment: ...

def barycentric_observer(
    name: Literal['earth', 'leo', 'l2'], time: Time | float, *,
    velocity: bool = False,
) -> CartesianRepresentation: ...

def blend(
    mixtures: Sequence[GaussianMixture], fractions: ArrayLike,
) -> GaussianMixture: ...

def bootstrap_median(
    values: ArrayLike, *, n_resamples: int = 10000,
    rng: Generator | int | None = None,
) -> NDArray[Any]: ...

def compare_n_components(
    image: ArrayLike | NDData, n_components: Sequence[int] = (1, 2, 3, 4, 5),
    **kwargs: Any,
) -> QTable: ...

def cramer_rao(
    psf: Union[GaussianMixture, GriddedMixturePSF, MultiGaussianPSFModel],
    flux: ArrayLike, sky: float = 0, *, x: ArrayLike = 0, y: ArrayLike = 0,
    read_noise: float = 0, gain: float = 1, exposure_time: float | None = None,
    fit_shape: int | tuple[int, int] = 15, free_sky: bool = False,
    jointly: bool = False,
) -> CramerRao: ...

def crowded_field(
    shape: int | tuple[int, int], *, density: float = 0.06346810008665511,
    magnitudes: tuple[float, ...] = (16.0, 26.0), margin: float = 24,
    rng: int | Generator = 0,
) -> QTable: ...

def csst_psf(
    shape: int | tuple[int, int] = (9232, 9216), band: str | Band = 'g', *,
    n_nodes: int = 5, variation: float = 1.0, rng: int | Generator = 24,
) -> GriddedMixturePSF: ...

def decode_motion_flags(flags: int) -> list[str]: ...

def decode_psf_flags(
    flags: int | ArrayLike, *, return_bit_values: bool = False,
) -> list: ...

def fit_crowded_psf(
    data: ArrayLike | NDData, *, error: float | ArrayLike | None = None,
    mask: ArrayLike | None = None, stars: Table | None = None,
    n_components: int = 6, degree: int | Literal['auto'] = 'auto',
    radius: float | None = None, max_stars: int = 300, min_snr: float = 50,
    saturation: float | None = None, effective_gain: float | None = None,
    background_size: float | None = 64, max_passes: int = 20,
    executor: Executor | None = None,
    checkpoint: str | PathLike[str] | None = None, progress_bar: bool = False,
) -> MixtureField: ...

def fit_many(
    images: Sequence[Any], coordinates: SkyCoord, *,
    fit_shape: int | tuple[int, int] = 11, common_flux: bool = False,
) -> QTable: ...

def fit_mixture(
    image: ArrayLike | NDData, n_components: int = 3, *,
    oversampling: int | tuple[int, int] = 1, origin: ArrayLike | None = None,
    error: float | ArrayLike | None = None, mask: ArrayLike | None = None,
    radius: float | None = None, enclosed_flux: float | None = None,
    normalize: Literal['free', 'tied'] = 'free', signed: bool = False,
    means: Literal['free', 'fixed'] = 'free',
    weighting: Literal['uniform', 'astrometric', 'photometric'] = 'uniform',
    start: GaussianMixture | Sequence[GaussianMixture] | None = None,
    executor: Executor | None = None,
) -> MixtureFit | list[MixtureFit]: ...

def fit_mixture_field(
    data: ArrayLike | NDData | list[Any], stars: Table | list[Table], *,
    error: ArrayLike | list[Any] | None = None,
    mask: ArrayLike | list[Any] | None = None,
    n_components: int | Literal['auto'] | None = None,
    degree: int | Literal['auto'] | None = None, radius: float | None = None,
    local_bkg: bool = False, effective_gain: float | None = None,
    reject: bool = True, regularization: float = 1.0,
    start: Union[GriddedMixturePSF, None] = None,
    centre: Literal['core', 'flux', 'catalogue'] = 'core',
    normalise: Literal['auto', 'stamps', 'curve-of-growth'] = 'auto',
    pixel_integrated: Literal['auto'] | bool = 'auto',
    correlated_noise: bool = True, contexts: Sequence[str] = (),
    brighter_fatter: bool | Literal['auto'] = False,
    executor: Executor | None = None, progress_bar: bool = False,
) -> MixtureField: ...

def inject_and_recover(
    photometry: CrowdedMixturePhotometry, data: ArrayLike | NDData,
    flux: ArrayLike | tuple[float, float], *, mask: ArrayLike | None = None,
    error: ArrayLike | None = None, separation: float = 20,
    radius: float = 0.7, flux_ratio: float = 2.5,
    flux_edges: ArrayLike | None = None, effective_gain: float = 1.0,
    repeats: int = 1, rng: Generator | int | None = None,
) -> InjectionResult: ...

def invert_wcs(
    wcs: BaseLowLevelWCS | BaseHighLevelWCS, coordinates: SkyCoord, *,
    start: Sequence[Any] | None = None, tolerance: float = 1e-07,
    max_iterations: int = 20,
) -> tuple[NDArray[Any], NDArray[Any]]: ...

def paper_exposures(
    ra: float = 192.8595, dec: float = 27.1283, *, offset: float = 3.0,
    rotation: float = 0.05, scale: float = 0.0001, distortion: float = 0.5,
    aberration: bool = False, rng: int | Generator = 2,
) -> list[Exposure]: ...

def paper_scene(
    field: Literal['ngp', 'ngp-psf', 'bulge'] = 'ngp',
    shape: int | tuple[int, int] | None = None, *, epoch: int = 3,
    psf: Union[GriddedMixturePSF, GriddedPSFModel, None] = None,
    effects: DetectorEffects | None = None, rng: int = 0,
    executor: Executor | None = None,
) -> Scene: ...

def pixel_error(
    light: ArrayLike | NDData, *, sky: ArrayLike = 0,
    read_noise: ArrayLike = 0, gain: ArrayLike = 1,
    exposure_time: float | None = None,
) -> NDArray[Any] | Quantity: ...

def pixel_phase_error(
    true: ArrayLike, measured: ArrayLike, *, n_bins: int = 8,
) -> PixelPhaseError: ...

def read_psfex(
    path: str | PathLike[str] | IO[Any], *,
    ext: int | str | tuple[str, int] | None = None,
) -> PSFExModel | dict[str, PSFExModel]: ...

def render_stars(
    psf: Union[GriddedMixturePSF, GriddedPSFModel], x: ArrayLike, y: ArrayLike,
    flux: ArrayLike, shape: int | tuple[int, int], *, faintest: float = 0.001,
    executor: Executor | None = None,
) -> NDArray[Any]: ...

def sample_mixture(
    image: ArrayLike | NDData, n_components: int = 3, *,
    prior: Literal['scaled', 'paper'] = 'scaled',
    pixel_scale: float | None = None, draws: int = 1000, tune: int = 500,
    chains: int = 4, sampler: Literal['pymc', 'nutpie', 'numpyro'] = 'pymc',
    cores: int | None = None, progress_bar: bool = False,
    rng: int | Generator | None = None, **kwargs: Any,
) -> MixturePosterior: ...

def select_n_components(
    image: ArrayLike | NDData, n_components: Sequence[int] = (1, 2, 3, 4, 5),
    *, r2_error: float | None = None, ellipticity_error: float | None = None,
    rms_residual: float | None = None, max_residual: float | None = None,
    phase_error: float | None = None, **kwargs: Any,
) -> int: ...

def select_psf_stars(
    data: ArrayLike | NDData, sources: Table | None = None, *,
    error: float | ArrayLike | None = None, mask: ArrayLike | None = None,
    fwhm: float | None = None, threshold: float | None = None,
    radius: float = 10, isolation: float | None = None,
    saturation: float | None = None, min_snr: float = 50,
    max_stars: int | None = None, finder: Callable[..., Any] | None = None,
    catalogue: Table | None = None,
) -> QTable: ...

def simulate(
    sources: Table, exposure: Exposure | None = None, *,
    instrument: Instrument | None = None,
    psf: Union[GriddedMixturePSF, GriddedPSFModel, None] = None,
    effects: DetectorEffects | None = None, rng: int | Generator,
    executor: Executor | None = None,
) -> Scene: ...

def simulate_catalogues(
    sources: Table, exposures: Sequence[Exposure], *,
    instrument: Instrument | None = None, psfs: Any = None,
    threshold: float = 5.0, rng: int | Generator,
    executor: Executor | None = None,
) -> list[SimulatedCatalogue]: ...

def simulate_epochs(
    sources: QTable, exposures: Sequence[Exposure], *,
    instrument: Instrument | None = None, psfs: Sequence[Any] | None = None,
    effects: DetectorEffects | None = None, rng: int | Generator,
    executor: Executor | None = None,
) -> list[Scene]: ...

def sky_field(
    n_stars: int = 614, n_qsos: int = 590, *, ra: float = 192.8595,
    dec: float = 27.1283, size: float = 11.3, parallaxes: bool = True,
    separation: float = 0.0, magnitudes: tuple[float, ...] | None = None,
    rng: int | Generator = 0,
) -> QTable: ...

def sparse_field(
    shape: int | tuple[int, int], *, spacing: int = 46,
    psf_fraction: float = 0.28,
    psf_magnitudes: tuple[float, ...] = (18.0, 20.5),
    magnitudes: tuple[float, ...] = (18.0, 26.0), rng: int | Generator = 0,
) -> QTable: ...

def to_flux_densities(
    table: QTable, *, pixel_area: Quantity | None = None,
    wcs: BaseLowLevelWCS | BaseHighLevelWCS | None = None,
    magnitudes: bool = False,
) -> QTable: ...
