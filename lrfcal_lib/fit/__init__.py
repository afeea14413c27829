"""One least-squares core: residuals with their derivatives, minimisation, results."""
