"""What `cfx.plugin` exports, by what it is for, and where each name lives.

Base classes and records stand here by their names. Functions and constants that belong together
are a module each: `canvas.blank(3.9)`, `threads.cores()`.
"""

# Components and their settings, parameters, the registry
from .core import distributions as distributions, registry as registry
from .core.component import (
    API_VERSION as API_VERSION,
    Component as Component,
    Settings as Settings,
    content_key as content_key,
    folder_hash as folder_hash,
)
from .core.parameters import (
    Parameter as Parameter,
    ParameterOverride as ParameterOverride,
    ParameterSpace as ParameterSpace,
    squashed as squashed,
)

# Datasets: pairs, tables with declared columns, tracks and their pairs, driving style
from .data import (
    names as names,
    statements as statements,
    steady as steady,
    style as style,
    tracks as tracks,
)
from .data.base import (
    Contents as Contents,
    Dataset as Dataset,
    DatasetSettings as DatasetSettings,
    FileDatasetSettings as FileDatasetSettings,
    joined as joined,
)
from .data.cells import NameColumn as NameColumn
from .data.files import (
    FileStart as FileStart,
    Floats as Floats,
    Ints as Ints,
    beginning as beginning,
    first_bytes as first_bytes,
    open_text as open_text,
    stem as stem,
    unpacking as unpacking,
)
from .data.pairs import Dropped as Dropped, Pair as Pair, PairBatch as PairBatch, PairSet as PairSet
from .data.pairs import Remark as Remark
from .data.resampling import COARSE_S as COARSE_S
from .data.signals import OBSERVED as OBSERVED, SIGNALS as SIGNALS, Signal as Signal
from .data.sites import with_sites as with_sites
from .data.style import (
    StyleResult as StyleResult,
)
from .data.table import (
    FileColumn as FileColumn,
    Layout as Layout,
    Table as Table,
    read_table as read_table,
)
from .data.tracks import (
    Tracks as Tracks,
    extract_pairs as extract_pairs,
)
from .data.units import length_mm as length_mm
from .data.whole import remarks_on_leaders as remarks_on_leaders

# Models: states, steps, limits, regimes, what SUMO calls them
from .models import composed as composed, regimes as regimes
from .models.base import (
    DrivingModel as DrivingModel,
    Follower as Follower,
    Leader as Leader,
    ModelSettings as ModelSettings,
    bumper_gap as bumper_gap,
)
from .models.limits import (
    LimitSettings as LimitSettings,
    at_limits as at_limits,
    is_at_limit as is_at_limit,
    limited_speed as limited_speed,
)
from .models.vtype import InSumo as InSumo, VType as VType, sumo_speed as sumo_speed

# Simulation: steppers, rollouts, windows
from .simulation.base import (
    Simulator as Simulator,
    SimulatorSettings as SimulatorSettings,
    Stepper as Stepper,
)
from .simulation.kernel.compiler import build_library as build_library
from .simulation.kernel.rows import (
    RowFunction as RowFunction,
    Rows as Rows,
    row_function as row_function,
)
from .simulation.kernel.run import step_key as step_key
from .simulation.rollout import MemoryStepper as MemoryStepper
from .simulation.rollout import simulate_follower as simulate_follower
from .simulation.settings import WindowSettings as WindowSettings
from .simulation.step import advance_vehicle as advance_vehicle
from .simulation.trajectory import (
    ComponentKey as ComponentKey,
    Segments as Segments,
    Start as Start,
    Terms as Terms,
)

# Calibration: objectives, optimizers, posteriors
from .calibration import identifiability as identifiability
from .calibration.losses import Prior as Prior, SegmentLosses as SegmentLosses
from .calibration.objectives import FrameValues as FrameValues, Objective as Objective
from .calibration.optimizers import CandidateLosses as CandidateLosses, Optimizer as Optimizer
from .calibration.posterior import (
    DriverPosteriors as DriverPosteriors,
    PosteriorMethod as PosteriorMethod,
)
from .calibration.settings import (
    CalibrationSettings as CalibrationSettings,
    INTERVAL_LEVEL as INTERVAL_LEVEL,
    MAX_PARETO_K as MAX_PARETO_K,
    MIN_NARROWING as MIN_NARROWING,
    MIXED as MIXED,
    are_reliable as are_reliable,
)
from .calibration.shards import Solver as Solver

# Policies: networks, inputs, heads, agents, checkpoints
from .policies import valid_range as valid_range
from .policies.agent import Agent as Agent, AgentState as AgentState
from .policies.base import (
    ConstantNetwork as ConstantNetwork,
    Policy as Policy,
    PolicyNetwork as PolicyNetwork,
    PolicySettings as PolicySettings,
    ResidualSettings as ResidualSettings,
)
from .policies.checkpoint import load_agent as load_agent, save_agent as save_agent
from .policies.constant import FixedPolicy as FixedPolicy
from .policies.context import DriverContext as DriverContext, ExpectedError as ExpectedError
from .policies.core import (
    ANY_DRIVER as ANY_DRIVER,
    AgentCore as AgentCore,
    features_read as features_read,
)
from .policies.driver_step import (
    DriverState as DriverState,
    DriverStep as DriverStep,
    Motion as Motion,
)
from .policies.driver_step import FREE_ROAD_M as FREE_ROAD_M
from .policies.features import (
    Scaler as Scaler,
    Summary as Summary,
)
from .policies.heads.base import DirectHead as DirectHead, ParameterHead as ParameterHead
from .policies.heads.stochastic import NOISE_SCALE as NOISE_SCALE, StochasticHead as StochasticHead
from .policies.history import History as History, measured_history as measured_history
from .policies.population import DriverPopulation as DriverPopulation
from .policies.inputs import require_no_further_signals as require_no_further_signals
from .policies.inputs.base import PolicyInput as PolicyInput
from .policies.known_drivers import (
    base_of as base_of,
    driver_features_of as driver_features_of,
)
from .policies.row_choice import DriverRows as DriverRows, RowChoice as RowChoice
from .policies.ready import (
    READY_FOLDER as READY_FOLDER,
    is_ready_made as is_ready_made,
    traffic_table as traffic_table,
)

# Learners
from .learners.base import (
    Learner as Learner,
    TrainingData as TrainingData,
    TrainingResult as TrainingResult,
)

# Evaluation: protocols, metrics, forecasts, statistics, demonstrations
from .evaluation import (
    forecasts as forecasts,
    headline as headline,
    roads as roads,
    statistics as statistics,
    traffic as traffic,
    waves as waves,
)
from .evaluation.closed_loop import Followers as Followers, burnt_in as burnt_in
from .evaluation.demo import DEMO_PAGE as DEMO_PAGE, Demo as Demo
from .evaluation.metrics.base import (
    Metric as Metric,
    MetricInfo as MetricInfo,
    RECORDED as RECORDED,
    SCOPES as SCOPES,
    Trajectories as Trajectories,
    key_of as key_of,
)
from .evaluation.protocols.agents import AgentBuilder as AgentBuilder
from .evaluation.protocols.base import (
    Protocol as Protocol,
    ProtocolContext as ProtocolContext,
    ProtocolResult as ProtocolResult,
)
from .evaluation.protocols.finished import (
    FoldsOrFinished as FoldsOrFinished,
    FoldsOrFinishedSettings as FoldsOrFinishedSettings,
)
from .evaluation.protocols import folds as folds
from .evaluation.protocols.held_out import HeldOut as HeldOut
from .evaluation.result import (
    Evaluation as Evaluation,
    FORECAST as FORECAST,
    METHODS as METHODS,
    PairTrajectory as PairTrajectory,
    Purpose as Purpose,
)
from .evaluation.sites import ALL_SITES as ALL_SITES
from .evaluation.statistics import (
    Improvement as Improvement,
)
from .evaluation.tables import in_text as in_text

# Results: tables of a job, its folder, where it is tracked
from .core import job_folder as job_folder
from .results import comparison as comparison
from .results.config import JobConfig as JobConfig
from .results.provenance import flatten as flatten
from .results.figure import JobFigure as JobFigure
from .results.reading import read_result as read_result
from .results.result import (
    OUTSIDE as OUTSIDE,
    ParameterAxis as ParameterAxis,
    Result as Result,
)
from .results.table import (
    Column as Column,
    ResultTable as ResultTable,
    Tables as Tables,
    stored_tables as stored_tables,
)
from .results.tracker import (
    Origin as Origin,
    Tracker as Tracker,
    Tracking as Tracking,
    folder_of as folder_of,
    tracking_of_run as tracking_of_run,
)

# Figures of a finished job, and how all figures look
from .figures import (
    canvas as canvas,
    colours as colours,
    drawing as drawing,
    wording as wording,
)
from .results.figures import (
    improvement_bars as improvement_bars,
    pair_lines as pair_lines,
    parameter_spread as parameter_spread,
)

# Sub-commands, formats of `cfx export`, engines; `main` runs a command line
from .core import engine as engine
from .app.cli import main as main
from .core.command import Command as Command, ExportFormat as ExportFormat
from .core.engine import (
    Engine as Engine,
)

# Files, progress, the console, threads and processes
from .core import console as console, files as files, storage as storage, threads as threads
from .core.memory import require_memory as require_memory
from .core.processes import worker_pool as worker_pool
from .core.progress import Task as Task
