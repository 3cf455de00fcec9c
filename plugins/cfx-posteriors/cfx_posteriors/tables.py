"""The tables of posteriors."""

from __future__ import annotations

from cfx.plugin import Column, ResultTable

PAIR = Column("pair_id", "", "the pair of leader and follower", "text")


class PosteriorDraws(ResultTable):
    """Draws of each driver's parameters from their posterior."""

    meaning = (
        "equally likely values of each driver's parameters, as correlated as the recording leaves"
        " them (`calibration.posterior`)"
    )
    order = 211
    columns = (
        PAIR,
        Column("chain", "1", "that the draw is of (`nuts`)", "int", required=False),
        Column("draw", "1", "its number within the pair, or the chain", "int"),
        Column("parameter_NAME", "as of the parameter", "the parameter"),
    )


class PopulationDraws(ResultTable):
    """New drivers of the population that all recordings give."""

    meaning = (
        "parameters of new drivers, as different and as correlated as the recorded ones"
        " (`calibration.posterior=hierarchical`)"
    )
    order = 212
    columns = (Column("parameter_NAME", "as of the parameter", "the parameter"),)


class PriorDraws(ResultTable):
    """Parameters of drivers before their recordings are seen."""

    meaning = (
        "parameters as likely as they are before a driver's recording is seen"
        " (`calibration.posterior=laplace`, `nuts`, `sbi`)"
    )
    order = 213
    columns = (Column("parameter_NAME", "as of the parameter", "the parameter"),)


class NoiseEvidence(ResultTable):
    """How evident each kind of noise is."""

    meaning = (
        "how evident each kind of noise is that was tried: the logarithm of how likely each"
        " recording is, whatever parameters and noise (`calibration.noise`)"
    )
    order = 215
    columns = (
        PAIR,
        Column("noise", "", "where noise enters, as after `calibration.noise=`", "text"),
        Column("log_evidence", "1", "up to a constant of the pair, that all kinds share"),
        Column("chosen", "1", "whether intervals rest on this kind", "bool"),
    )


class Fan(ResultTable):
    """What posteriors say of trajectories."""

    meaning = (
        "90 % of the trajectories of each driver's posterior: predicted without noise on the part"
        " that was calibrated on, then forecasts with it (`calibration.posterior`)"
    )
    order = 214
    columns = (
        PAIR,
        Column("time_s", "s", "since the recording's start"),
        Column("calibrated_on", "1", "whether this part was calibrated on", "bool"),
        Column("signal", "", "`speed` (m/s) or `gap` (m)", "text"),
        Column("measured", "m/s or m", "what was recorded"),
        Column("low", "m/s or m", "5 % are below"),
        Column("median", "m/s or m", "half are below"),
        Column("high", "m/s or m", "5 % are above"),
    )
