//! The seam between the networks and whatever computes them.

use rare::Result;

use crate::Parameter;

/// The sizes of a tensor of activations: images of `height x width` pixels with `channels` values each. A sequence of
/// tokens is an image of height 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shape {
    /// Number of images.
    pub batch: usize,
    /// Rows of an image.
    pub height: usize,
    /// Columns of an image.
    pub width: usize,
    /// Values per pixel.
    pub channels: usize,
}

impl Shape {
    /// Pixels of all images.
    #[must_use]
    pub fn pixels(&self) -> usize {
        self.batch * self.height * self.width
    }

    /// Number of values.
    #[must_use]
    pub fn values(&self) -> usize {
        self.pixels() * self.channels
    }
}

/// The weights of a convolution as files hold them, for [`Backend::pack`].
#[derive(Debug, Clone, Copy)]
pub struct Kernel<'a> {
    /// One or more tensors `outputs x inputs x 1 x 1`, `outputs x inputs x 3 x 3` or `outputs x inputs`, all with the
    /// same inputs and side; their outputs are put one after the other.
    pub parts: &'a [Parameter],
    /// One value per output, or none.
    pub bias: Option<&'a [f32]>,
    /// What the outputs mean.
    pub arrangement: Arrangement,
}

/// What the outputs of a convolution mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Arrangement {
    /// Every output is a channel.
    Plain,
    /// The first half are values, the second half their gates: the result is `value * gelu(gate)` (exact GELU by the
    /// error function), with half as many channels (Shazeer: GLU Variants Improve Transformer, 2020).
    Gated,
}

/// What happens to the input of a convolution before it is multiplied.
#[derive(Debug, Clone, Copy)]
pub enum Prologue<'a> {
    /// Nothing.
    None,
    /// `x * sigmoid(x)`.
    Silu,
    /// Group normalisation of each image (Wu and He, 2018), then an activation.
    GroupNormalization {
        /// Number of groups; they divide the channels.
        groups: usize,
        /// Added to the variance.
        epsilon: f32,
        /// Factor per channel.
        scale: &'a [f32],
        /// Summand per channel.
        shift: &'a [f32],
        /// Whether `x * sigmoid(x)` follows.
        silu: bool,
    },
    /// Layer normalisation of each pixel over its channels (Ba, Kiros, Hinton, 2016).
    LayerNormalization {
        /// Added to the variance.
        epsilon: f32,
        /// Factor per channel.
        scale: &'a [f32],
        /// Summand per channel.
        shift: &'a [f32],
    },
}

/// What happens to the output of a convolution after bias and offset and before the residual.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Activation {
    /// Nothing.
    None,
    /// `x * sigmoid(x)`.
    Silu,
    /// `x * sigmoid(1.702 x)`.
    QuickGelu,
}

/// Everything that one call of [`Backend::convolve`] does. A 1 x 1 kernel on a sequence is a linear layer.
///
/// `residual + activation(kernel * upsampled(prologue(input)) + bias + offset)`, padded with zeros so that a 3 x 3 kernel
/// keeps the size.
#[derive(Debug)]
pub struct Convolution<'a, T> {
    /// Before.
    pub prologue: Prologue<'a>,
    /// Whether the image is doubled in both directions first (nearest neighbour).
    pub upsample: bool,
    /// 1, or 2 to keep every other row and column, starting with the first.
    pub stride: usize,
    /// A summand per output, beside the bias: a tensor of one pixel. Not with gated outputs.
    pub offset: Option<&'a T>,
    /// After.
    pub activation: Activation,
    /// Added at the end. It has the shape of the result, or fewer images: then image `i` takes number `i mod batch`.
    pub residual: Option<&'a T>,
    /// Whether the result only goes into further products, so that it may be kept in the precision of the products.
    pub intermediate: bool,
}

impl<T> Default for Convolution<'_, T> {
    fn default() -> Self {
        Convolution {
            prologue: Prologue::None,
            upsample: false,
            stride: 1,
            offset: None,
            activation: Activation::None,
            residual: None,
            intermediate: false,
        }
    }
}

/// Computes networks. Tensors and weights live where the backend wants them.
///
/// All methods give `Internal` for shapes that do not fit, which is a defect of the network that calls them, and
/// whatever error the device has.
pub trait Backend: Send + Sync {
    /// Activations.
    type Tensor: Send + Sync;
    /// The packed weights of a convolution.
    type Weight: Send + Sync;

    /// Packs weights once, for use in many calls.
    ///
    /// # Errors
    /// `Internal` if the parts do not fit.
    fn pack(&self, kernel: &Kernel<'_>) -> Result<Self::Weight>;

    /// Takes values in the order image, row, column, channel.
    ///
    /// # Errors
    /// `Internal` if the number of values is not that of the shape, or if there are none.
    fn upload(&self, shape: Shape, values: &[f32]) -> Result<Self::Tensor>;

    /// The values in the order image, row, column, channel.
    ///
    /// # Errors
    /// What the device has.
    fn download(&self, tensor: &Self::Tensor) -> Result<Vec<f32>>;

    /// The sizes of a tensor.
    fn shape(&self, tensor: &Self::Tensor) -> Shape;

    /// A convolution with everything around it.
    ///
    /// # Errors
    /// `Internal` if shapes do not fit.
    fn convolve(
        &self,
        input: &Self::Tensor,
        weight: &Self::Weight,
        fused: &Convolution<'_, Self::Tensor>,
    ) -> Result<Self::Tensor>;

    /// Attention of the pixels of each image to each other (Vaswani et al., 2017). The channels are queries, keys and
    /// values, a third each, every third made of `heads` equal parts. With `causal`, a pixel sees those before it and
    /// itself.
    ///
    /// # Errors
    /// `Internal` if the channels do not divide.
    fn self_attention(
        &self,
        queries_keys_values: &Self::Tensor,
        heads: usize,
        causal: bool,
    ) -> Result<Self::Tensor>;

    /// Attention of the pixels of each image to the tokens of a context. Each context (one image; keys, then values,
    /// half of the channels each) serves an equal share of the images, in order.
    ///
    /// # Errors
    /// `Internal` if channels or batch do not divide.
    fn cross_attention(
        &self,
        queries: &Self::Tensor,
        contexts: &[&Self::Tensor],
        heads: usize,
    ) -> Result<Self::Tensor>;

    /// The channels of `first`, then those of `second`, which has the same pixels.
    ///
    /// # Errors
    /// `Internal` if the pixels differ.
    fn concatenate(&self, first: &Self::Tensor, second: &Self::Tensor) -> Result<Self::Tensor>;
}
