//! Normalisations, which run as the prologue of a convolution.

use crate::engine::Prologue;

/// Group normalisation (Wu and He, 2018).
pub(crate) struct GroupNormalization {
    pub(crate) groups: usize,
    pub(crate) epsilon: f32,
    /// Factor per channel.
    pub(crate) scale: Vec<f32>,
    /// Summand per channel.
    pub(crate) shift: Vec<f32>,
}

impl GroupNormalization {
    /// The normalisation alone.
    pub(crate) fn plain(&self) -> Prologue<'_> {
        self.prologue(false)
    }

    /// The normalisation, then `x * sigmoid(x)`.
    pub(crate) fn then_silu(&self) -> Prologue<'_> {
        self.prologue(true)
    }

    fn prologue(&self, silu: bool) -> Prologue<'_> {
        let GroupNormalization { groups, epsilon, scale, shift } = self;
        Prologue::GroupNormalization { groups: *groups, epsilon: *epsilon, scale, shift, silu }
    }
}

/// Layer normalisation (Ba, Kiros, Hinton, 2016).
pub(crate) struct LayerNormalization {
    pub(crate) epsilon: f32,
    /// Factor per channel.
    pub(crate) scale: Vec<f32>,
    /// Summand per channel.
    pub(crate) shift: Vec<f32>,
}

impl LayerNormalization {
    /// The normalisation before a linear layer.
    pub(crate) fn prologue(&self) -> Prologue<'_> {
        Prologue::LayerNormalization {
            epsilon: self.epsilon,
            scale: &self.scale,
            shift: &self.shift,
        }
    }

    /// Normalises rows of values on the host, with sums in double precision.
    pub(crate) fn apply(&self, values: &mut [f32]) {
        for row in values.chunks_exact_mut(self.scale.len().max(1)) {
            let count = row.len() as f64;
            let mean = row.iter().map(|&value| f64::from(value)).sum::<f64>() / count;
            let squares = row.iter().map(|&value| (f64::from(value) - mean).powi(2)).sum::<f64>();
            let factor = 1.0 / (squares / count + f64::from(self.epsilon)).sqrt();
            for ((value, &scale), &shift) in row.iter_mut().zip(&self.scale).zip(&self.shift) {
                let normalized = (f64::from(*value) - mean) * factor;
                *value = (normalized * f64::from(scale) + f64::from(shift)) as f32;
            }
        }
    }
}
