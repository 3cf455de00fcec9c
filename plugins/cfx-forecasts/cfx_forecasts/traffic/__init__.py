"""Traffic of many sampled drivers: on ring roads, through a bottleneck, in platoons."""
