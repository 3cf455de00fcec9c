"""The batched rollout of a driving model along leaders; `step` alone integrates."""
