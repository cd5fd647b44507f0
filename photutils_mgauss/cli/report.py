"""``mgauss report``: results to figures and one page of HTML."""
from importlib.util import find_spec
from pathlib import Path

from photutils_mgauss.cli import tools
from photutils_mgauss.cli.progress import Progress


def add(commands):
    """Add the command to the parser's."""
    parser = tools.command(
        commands, 'report', 'figures and a page of HTML of results',
        'Show PSFs, catalogues and proper motions on one page of HTML, which '
        'contains its figures and needs no other file.',
        'mgauss report night1_psf.fits night1_cat.ecsv mgauss_motions '
        '--output report.html', run)
    tools.add_inputs(parser, 'PATH',
                     'results of other commands, or folders of them')
    parser.add_argument('--output', default='mgauss_report.html',
                        metavar='FILE', help='default: %(default)s')
    parser.add_argument('--title', default='Positions and proper motions',
                        help='of the page (default: %(default)s)')
    parser.add_argument('--field', metavar='FOLDER',
                        help='output of mgauss motions; adds a comparison of '
                             'each catalogue with the other exposures of its '
                             'field')
    tools.add_overwrite(parser)


def run(options):
    """Write the page."""
    output = Path(options.output)
    if output.suffix not in ('.html', '.htm'):
        msg = f'{output}: --output must end with .html'
        raise ValueError(msg)
    tools.check_different(options.inputs)
    paths = _files(options.inputs)
    tools.claim([output], options.overwrite, options.inputs)
    _check_matplotlib()
    with Progress(len(paths) + 1, options) as step:
        sections = [_section(path, named, step) for path, named in paths]
        sections = [section for section in sections if section is not None]
        if not sections:
            msg = f'{options.inputs[0]}: must hold results, got none'
            raise ValueError(msg)
        if options.field is not None:
            from photutils_mgauss.cli.field_section import field_sections
            sections += field_sections(options.field,
                                       [path for path, _ in paths])
        step('draw figures')
        _write(options, sections, output)
    number = f'{len(sections)} result{"s" * (len(sections) > 1)}'
    tools.say(options, f'{output}: {number}')


def _write(options, sections, output):
    from photutils_mgauss.cli.page import html_page
    page = html_page(options.title, sections, tools.record_of(options))
    with tools.whole_file(output) as draft:
        draft.write_text(page, encoding='utf-8')


def _files(inputs):
    """Return (path, whether it was named itself) of all files."""
    found = []
    for path in map(Path, inputs):
        if not path.is_dir():
            tools.check_inputs([path])
        found += [(file, not path.is_dir()) for file in tools.files_in([path])]
    return found


def _section(path, named, step):
    from photutils_mgauss.cli.sections import section_of
    step(f'read {path}')
    with tools.about(path):
        section = section_of(path)
    if section is None and named:
        msg = (f'{path}: must be a PSF, a catalogue, proper motions, an '
               'alignment or residuals')
        raise ValueError(msg)
    return section


def _check_matplotlib():
    if find_spec('matplotlib') is None:
        msg = ('matplotlib must be installed for reports: '
               "pip install 'photutils_mgauss[plot]'")
        raise ValueError(msg)
