"""
The command ``mgauss``, one module for each of its subcommands.

`command` reads the arguments and calls the module of the subcommand (`psf`,
`photometry`, `motions`, `report`, `demo_command`). All of them pass through
`running`, which turns errors, warnings and interrupts into sentences and exit
codes. `tools` has what they share: options, names of files, records of what
was done; `progress` shows how far they are, `results` keeps what is finished
until it is written. `observers` and `targets` read from where and what
`motions` looks at. `demo` is the demonstration, `sections` and `page` write
the report, `psf_files` and `star_image` turn the files a user names into PSF
grids and images. Every
subcommand does what a few public calls do, so nothing outside this room
imports from it; add an option here only for what those calls can do.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {'main': 'command'})
