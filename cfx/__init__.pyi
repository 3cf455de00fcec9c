"""What `cfx` exports, and where each name lives."""

from . import errors as errors
from . import plugin as plugin
from .api.experiment import Experiment as Experiment
from .api.experiment import config as config
from .api.experiment import evaluate as evaluate
from .api.experiment import from_config as from_config
from .api.experiment import model as model
from .api.experiment import train as train
from .api.fit import Fit as Fit
from .api.fit import calibrate as calibrate
from .api.fit import calibrate_pooled as calibrate_pooled
from .api.fit import compare as compare
from .api.forecasts import Forecast as Forecast
from .api.forecasts import forecast as forecast
from .api.pairs import Pairs as Pairs
from .api.pairs import read as read
from .api.simulation import simulate as simulate
from .app.application import run as run
from .core.registry import get as get
from .results.reading import load as load

__version__: str
