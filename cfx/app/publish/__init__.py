"""Makes ready-made policies of finished jobs, and shows them: `cfx policies`."""
