"""Readers of recordings that others have published: highD, OpenACC, FollowNet, Waymo, Lyft."""
