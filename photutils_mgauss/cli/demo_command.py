"""``mgauss demo``: simulated images to motions beside the truth."""
from pathlib import Path

from photutils_mgauss.cli import tools
from photutils_mgauss.cli.progress import Progress


def add(commands):
    """Add the command to the parser's."""
    demo = tools.command(
        commands, 'demo', 'simulate a field at several epochs and measure it',
        'Simulate a small field at several epochs, make the PSF of each '
        'image from its own stars, measure all stars, align the epochs on '
        'quasars, fit proper motions, and compare them with the truth.',
        'mgauss demo --epochs 3 --output my_demo', run)
    tools.add_folder(demo, 'mgauss_demo')
    demo.add_argument('--epochs', type=int, choices=range(2, 8), default=5,
                      help='number of epochs (default: %(default)s)')
    demo.add_argument('--size', type=tools.count, default=1024,
                      metavar='PIXELS',
                      help='side of the detector (default: %(default)s)')
    demo.add_argument('--seed', type=int, default=1,
                      help='of the simulation (default: %(default)s)')
    demo.add_argument('--images-only', action='store_true',
                      help='only write the images, as FITS, and the quasars, '
                           'for trying the other commands')
    tools.add_overwrite(demo)


def run(options):
    """Run the demonstration."""
    folder = Path(options.output)
    tools.check_folder(folder)
    if folder.exists() and any(folder.iterdir()) and not options.overwrite:
        msg = (f'{folder} has files in it; choose another --output or add '
               '--overwrite')
        raise FileExistsError(msg)
    n_steps = options.epochs * (1 if options.images_only else 2) + 1
    with Progress(n_steps, options) as step:
        paths, lines = _make(options, folder, step)
    tools.say(options, *lines, '', f'{len(paths)} files in {folder}')


def _make(options, folder, step):
    """Write the files; return their paths and what is to be said."""
    from photutils_mgauss.cli import demo

    def progress(pieces, words):
        for number, piece in enumerate(pieces, 1):
            step(f'{words} {number} of {len(pieces)}')
            yield piece

    sources, scenes = demo.take_images(_settings(options, demo), progress)
    if options.images_only:
        step(f'write to {folder}')
        return demo.write_images(scenes, sources, folder), []
    measured = [demo.measure(scene) for scene in progress(scenes, 'measure')]
    step('align and fit')
    result = demo.find_motions(measured, sources)
    paths = demo.write(result, folder) + _draw(options, result, folder)
    return paths, demo.summary(result)


def _settings(options, demo):
    density = (options.size / 1024) ** 2
    return demo.Settings(
        n_epochs=options.epochs, size=options.size, seed=options.seed,
        n_stars=round(350 * density), n_qsos=round(120 * density))


def _draw(options, result, folder):
    """Draw the two figures if matplotlib is there; return their paths."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        tools.say(options, 'no figures: matplotlib is not installed')
        return []
    from photutils_mgauss.cli import demo
    paths = []
    for name, plot in (('positions', demo.plot_positions),
                       ('motions', demo.plot_motions)):
        figure = Figure(figsize=(9, 4), layout='constrained')
        plot(result, figure.subplots(1, 2))
        paths.append(folder / f'{name}.png')
        with tools.whole_file(paths[-1]) as draft:
            figure.savefig(draft, dpi=150)
    return paths
