"""The nouns of cfx, for authors of plugins: base classes, records, and the functions they call.

    from cfx.plugin import DrivingModel, Parameter, ParameterSpace

A plugin imports from `cfx`, `cfx.plugin`, `cfx.errors` and `cfx_contracts` alone; everything else
may change. `plugin.pyi` lists the names, by what they are for. Each is imported when it is first
used, so that importing this module imports nothing heavy.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub("cfx", __file__)
