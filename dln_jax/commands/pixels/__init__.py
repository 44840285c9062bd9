"""The pixel pendulum: films of a swinging rod, the fit of an autoencoder with dynamics in its plane, and figures."""
