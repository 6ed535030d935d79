"""Lost, stuck and slipping sensors, heading drift, magnetic disturbance."""
