//! The number types that weight files use.

use std::fmt;

/// The type of the elements of a tensor in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ElementType {
    /// Double precision.
    F64,
    /// Single precision.
    F32,
    /// Half precision (IEEE 754 binary16).
    F16,
    /// The upper half of single precision.
    Bf16,
    /// Eight bits, four or five of them exponent; known, so that files that contain it open, but never read.
    F8,
    /// Signed, 64 bits.
    I64,
    /// Signed, 32 bits.
    I32,
    /// Signed, 16 bits.
    I16,
    /// Signed, 8 bits.
    I8,
    /// Unsigned, 64 bits.
    U64,
    /// Unsigned, 32 bits.
    U32,
    /// Unsigned, 16 bits.
    U16,
    /// Unsigned, 8 bits.
    U8,
    /// One byte, 0 or 1.
    Bool,
}

impl ElementType {
    /// Bytes per element.
    #[must_use]
    pub fn bytes(self) -> usize {
        match self {
            ElementType::F64 | ElementType::I64 | ElementType::U64 => 8,
            ElementType::F32 | ElementType::I32 | ElementType::U32 => 4,
            ElementType::F16 | ElementType::Bf16 | ElementType::I16 | ElementType::U16 => 2,
            ElementType::F8 | ElementType::I8 | ElementType::U8 | ElementType::Bool => 1,
        }
    }

    /// The type that a safetensors header calls `name`.
    pub(super) fn from_safetensors(name: &str) -> Option<ElementType> {
        Some(match name {
            "F64" => ElementType::F64,
            "F32" => ElementType::F32,
            "F16" => ElementType::F16,
            "BF16" => ElementType::Bf16,
            "F8_E4M3" | "F8_E5M2" => ElementType::F8,
            "I64" => ElementType::I64,
            "I32" => ElementType::I32,
            "I16" => ElementType::I16,
            "I8" => ElementType::I8,
            "U64" => ElementType::U64,
            "U32" => ElementType::U32,
            "U16" => ElementType::U16,
            "U8" => ElementType::U8,
            "BOOL" => ElementType::Bool,
            _ => return None,
        })
    }
}

impl fmt::Display for ElementType {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            ElementType::F64 => "F64",
            ElementType::F32 => "F32",
            ElementType::F16 => "F16",
            ElementType::Bf16 => "BF16",
            ElementType::F8 => "F8",
            ElementType::I64 => "I64",
            ElementType::I32 => "I32",
            ElementType::I16 => "I16",
            ElementType::I8 => "I8",
            ElementType::U64 => "U64",
            ElementType::U32 => "U32",
            ElementType::U16 => "U16",
            ElementType::U8 => "U8",
            ElementType::Bool => "BOOL",
        })
    }
}
