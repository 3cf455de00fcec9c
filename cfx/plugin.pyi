"""What `cfx.plugin` exports, by what it is for, and where each name lives."""

# Components and their settings, parameters, the registry
from .core.component import (
    API_VERSION as API_VERSION,
    Component as Component,
    Settings as Settings,
    content_key as content_key,
    folder_hash as folder_hash,
)
from .core.distributions import OWN as OWN, install_line as install_line
from .core.parameters import (
    Parameter as Parameter,
    ParameterOverride as ParameterOverride,
    ParameterSpace as ParameterSpace,
    squashed as squashed,
)
from .core.registry import (
    KINDS as KINDS,
    create as create,
    entries as entries,
    get as get,
    installed as installed,
)

# Datasets: pairs, tables with declared columns, tracks and their pairs, driving style
from .data.base import (
    Contents as Contents,
    Dataset as Dataset,
    DatasetSettings as DatasetSettings,
    FileDatasetSettings as FileDatasetSettings,
    joined as joined,
)
from .data.files import (
    FileStart as FileStart,
    Floats as Floats,
    Ints as Ints,
    beginning as beginning,
    first_bytes as first_bytes,
    open_text as open_text,
    stem as stem,
)
from .data.pairs import Dropped as Dropped, Pair as Pair, PairBatch as PairBatch, PairSet as PairSet
from .data.pairs import Remark as Remark
from .data.signals import COARSE_S as COARSE_S
from .data.sites import with_sites as with_sites
from .data.style import (
    ALL_TYPES as ALL_TYPES,
    CLUSTERS as CLUSTERS,
    Group as Group,
    INDICATORS as INDICATORS,
    StyleResult as StyleResult,
    groups as groups,
    name_of_indicator as name_of_indicator,
)
from .data.table import (
    FileColumn as FileColumn,
    Layout as Layout,
    NameColumn as NameColumn,
    Table as Table,
    read_table as read_table,
)
from .data.tracks import (
    Marks as Marks,
    NOBODY as NOBODY,
    SINGLE_FRAME as SINGLE_FRAME,
    Tracks as Tracks,
    accelerations as accelerations,
    changes as changes,
    counted as counted,
    driven as driven,
    extract_pairs as extract_pairs,
    first_of as first_of,
    runs as runs,
    summed as summed,
    unique_name as unique_name,
)
from .data.tracks import (
    next_in_lane as next_in_lane,
    rows_ahead as rows_ahead,
    vehicles_apart as vehicles_apart,
)
from .data.units import length_mm as length_mm
from .data.statements import Statement as Statement, remarks_of as remarks_of
from .data.whole import remarks_on_leaders as remarks_on_leaders
from .data.names import name_of as name_of, named_twice as named_twice, names_of as names_of

# Models: states, steps, limits, regimes, what SUMO calls them
from .models.base import (
    DrivingModel as DrivingModel,
    Follower as Follower,
    Leader as Leader,
    ModelSettings as ModelSettings,
    bumper_gap as bumper_gap,
)
from .models.composed import (
    COMFORTABLE_BRAKING as COMFORTABLE_BRAKING,
    RELAXATION_TIME as RELAXATION_TIME,
    SPEED_LIMIT as SPEED_LIMIT,
    WithSpeedLimit as WithSpeedLimit,
)
from .models.limits import (
    LimitSettings as LimitSettings,
    at_limits as at_limits,
    limited_speed as limited_speed,
)
from .models.regimes import (
    SPACING_WIDTH as SPACING_WIDTH,
    SPEED_WIDTH as SPEED_WIDTH,
    safe_divisor as safe_divisor,
    safe_sqrt as safe_sqrt,
    switches_exactly as switches_exactly,
    where_below as where_below,
    where_up_to as where_up_to,
)
from .models.vtype import InSumo as InSumo, VType as VType, sumo_speed as sumo_speed

# Simulation: steppers, rollouts, windows
from .simulation.base import (
    Simulator as Simulator,
    SimulatorSettings as SimulatorSettings,
    Stepper as Stepper,
)
from .simulation.kernel.compiler import build_library as build_library
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
from .calibration.identifiability import (
    FLAT_SHARE_PREFIX as FLAT_SHARE_PREFIX,
    NEARLY_BEST as NEARLY_BEST,
    flat_shares as flat_shares,
)
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
    are_reliable as are_reliable,
)
from .calibration.shards import Solver as Solver

# Policies: networks, inputs, heads, agents, checkpoints
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
    History as History,
    Scaler as Scaler,
    Summary as Summary,
    measured_history as measured_history,
)
from .policies.heads.base import DirectHead as DirectHead, ParameterHead as ParameterHead
from .policies.heads.stochastic import NOISE_SCALE as NOISE_SCALE, StochasticHead as StochasticHead
from .policies.ready import READY_FOLDER as READY_FOLDER
from .policies.valid_range import (
    FADED as FADED,
    RANGE_SIGNALS as RANGE_SIGNALS,
    share_in_words as share_in_words,
)

# Learners
from .learners.base import (
    Learner as Learner,
    TrainingData as TrainingData,
    TrainingResult as TrainingResult,
)
from .learners.curves import (
    first_sampled_epoch as first_sampled_epoch,
    over_networks as over_networks,
)

# Evaluation: protocols, metrics, forecasts, statistics, demonstrations
from .evaluation.closed_loop import Followers as Followers, burnt_in as burnt_in
from .evaluation.demo import DEMO_PAGE as DEMO_PAGE, Demo as Demo
from .evaluation.forecasts import (
    LeaderFuture as LeaderFuture,
    Origins as Origins,
    Paths as Paths,
    extrapolated as extrapolated,
    measured_paths as measured_paths,
    sample_from_origins as sample_from_origins,
)
from .evaluation.headline import (
    Comparison as Comparison,
    contradiction as contradiction,
    opposite as opposite,
)
from .evaluation.metrics.base import (
    Metric as Metric,
    MetricInfo as MetricInfo,
    RECORDED as RECORDED,
    SCOPES as SCOPES,
    Trajectories as Trajectories,
    column_of as column_of,
    key_of as key_of,
)
from .evaluation.protocols.base import (
    Protocol as Protocol,
    ProtocolContext as ProtocolContext,
    ProtocolResult as ProtocolResult,
)
from .evaluation.protocols.finished import (
    FoldsOrFinished as FoldsOrFinished,
    FoldsOrFinishedSettings as FoldsOrFinishedSettings,
)
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
    Against as Against,
    Improvement as Improvement,
    against_the_best as against_the_best,
    improvement_statistics as improvement_statistics,
    mean_interval as mean_interval,
    verdict as verdict,
)
from .evaluation.tables import in_text as in_text

# Results: tables of a job, its folder, where it is tracked
from .core.job_folder import (
    examine as examine,
    optional as optional,
    parse_json as parse_json,
    parse_yaml as parse_yaml,
    read_json as read_json,
    read_yaml as read_yaml,
    without_folders as without_folders,
)
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
    metrics_table as metrics_table,
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
from .figures.canvas import (
    Array as Array,
    DASHES as DASHES,
    Dash as Dash,
    HIDDEN as HIDDEN,
    Line as Line,
    Paper as Paper,
    WIDTH as WIDTH,
    canvas as canvas,
    draw_lines as draw_lines,
    draw_points as draw_points,
    figure_style as figure_style,
    finite as finite,
    hover as hover,
    hover_text as hover_text,
    legend_above as legend_above,
    logarithmic as logarithmic,
    mark_points as mark_points,
    method_legend as method_legend,
    most_across as most_across,
    on_paper as on_paper,
    percent_axis as percent_axis,
    percent_tick as percent_tick,
    plain_tick as plain_tick,
    points as points,
    side_by_side as side_by_side,
    styled as styled,
    vehicle_colour as vehicle_colour,
    wrapped as wrapped,
    write_note as write_note,
)
from .figures.drawing import (
    FIGURE_METADATA as FIGURE_METADATA,
    draw_figure as draw_figure,
    figure_named as figure_named,
    write_figure as write_figure,
    write_figures as write_figures,
)
from .figures.text import (
    BAND as BAND,
    CLUSTER_COLOURS as CLUSTER_COLOURS,
    COLLISION_COLOUR as COLLISION_COLOUR,
    COLOURS as COLOURS,
    EDGE as EDGE,
    FULL_TRAJECTORY as FULL_TRAJECTORY,
    INK as INK,
    JOB_COLOURS as JOB_COLOURS,
    MINUS as MINUS,
    NOTHING as NOTHING,
    STEADY as STEADY,
    TEST as TEST,
    TRAIN_COLOUR as TRAIN_COLOUR,
    VALIDATION_COLOUR as VALIDATION_COLOUR,
    colour_of as colour_of,
    common_prefix as common_prefix,
    explained as explained,
    few_drivers as few_drivers,
    method_label as method_label,
    number_text as number_text,
    percent as percent,
    percent_or_undefined as percent_or_undefined,
    plural as plural,
    pretty_unit as pretty_unit,
    short_label as short_label,
    shortened as shortened,
    unit_label as unit_label,
)

# Sub-commands, formats of `cfx export`, engines; `main` runs a command line
from .app.cli import main as main
from .core.command import Command as Command, ExportFormat as ExportFormat
from .core.engine import (
    Engine as Engine,
    Report as Report,
    ResultT as ResultT,
    ShardT as ShardT,
    Unfit as Unfit,
    Work as Work,
)

# Files, progress, the console, threads and processes
from .core.console import (
    blank_table as blank_table,
    console_logging as console_logging,
    print_table as print_table,
)
from .core.files import (
    atomic_write as atomic_write,
    path_override as path_override,
    write_json as write_json,
    write_output as write_output,
)
from .core.memory import require_memory as require_memory
from .core.processes import worker_pool as worker_pool
from .core.progress import Task as Task
from .core.storage import is_url as is_url, local_folder as local_folder
from .core.threads import (
    cores as cores,
    limit_cores as limit_cores,
    one_thread as one_thread,
    own_cores as own_cores,
)
