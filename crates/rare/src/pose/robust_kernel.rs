//! Robust kernels: how much a residual may still say.

use serde::{Deserialize, Serialize};

/// How a residual `r` loses weight as it grows beyond the kernel width `k`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RobustKernel {
    /// `1` everywhere: least squares.
    None,
    /// `(1 - (r/k)^2)^2`, 0 from `k` on: wrong pairs lose all influence.
    Tukey,
    /// `1` up to `k`, then `k/|r|`.
    Huber,
    /// `1 / (1 + (r/k)^2)`.
    Cauchy,
    /// `1 / (1 + (r/k)^2)^2`.
    #[serde(rename = "geman-mcclure")]
    GemanMcClure,
}

impl RobustKernel {
    /// The weight (0 to 1) of a residual, both lengths in metres.
    #[must_use]
    pub fn weight(self, residual: f64, width: f64) -> f64 {
        let square = (residual / width).powi(2);
        match self {
            RobustKernel::None => 1.0,
            RobustKernel::Tukey => (1.0 - square.min(1.0)).powi(2),
            RobustKernel::Huber => width / residual.abs().max(width),
            RobustKernel::Cauchy => 1.0 / (1.0 + square),
            RobustKernel::GemanMcClure => 1.0 / (1.0 + square).powi(2),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_fall_from_one_as_documented() {
        for (kernel, at_half, at_double) in [
            (RobustKernel::None, 1.0, 1.0),
            (RobustKernel::Tukey, 0.5625, 0.0),
            (RobustKernel::Huber, 1.0, 0.5),
            (RobustKernel::Cauchy, 0.8, 0.2),
            (RobustKernel::GemanMcClure, 0.64, 0.04),
        ] {
            assert_eq!(kernel.weight(0.0, 0.3), 1.0);
            assert!((kernel.weight(-0.15, 0.3) - at_half).abs() < 1e-12, "{kernel:?}");
            assert!((kernel.weight(0.6, 0.3) - at_double).abs() < 1e-12, "{kernel:?}");
        }
    }
}
