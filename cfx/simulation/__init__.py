"""The batched rollout of a driving model along leaders; the only place that integrates."""
