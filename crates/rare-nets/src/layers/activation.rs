//! What follows a linear layer.

/// A function of each number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Activation {
    None,
    Relu,
    /// The slope below zero is 0.1.
    LeakyRelu,
    /// The slope below zero is 0.2.
    LeakierRelu,
}

impl Activation {
    pub(crate) fn apply(self, value: f32) -> f32 {
        match self {
            Activation::None => value,
            Activation::Relu => value.max(0.0),
            Activation::LeakyRelu => value.max(0.1 * value),
            Activation::LeakierRelu => value.max(0.2 * value),
        }
    }

    /// Applies it to all numbers.
    pub(crate) fn apply_to(self, values: &mut [f32]) {
        if self != Activation::None {
            values.iter_mut().for_each(|value| *value = self.apply(*value));
        }
    }
}
