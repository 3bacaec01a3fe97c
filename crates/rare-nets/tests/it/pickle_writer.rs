//! Small pickles of our own making, from the operations that Python writes.

/// A pickle of protocol 2, put together from the operations that Python writes.
pub(crate) struct Pickle(pub(crate) Vec<u8>);

impl Pickle {
    pub(crate) fn text(mut self, text: &str) -> Pickle {
        self.0.push(b'X');
        self.0.extend((text.len() as u32).to_le_bytes());
        self.0.extend(text.as_bytes());
        self
    }

    pub(crate) fn number(mut self, number: f64) -> Pickle {
        self.0.push(b'G');
        self.0.extend(number.to_be_bytes());
        self
    }

    pub(crate) fn integer(mut self, number: u8) -> Pickle {
        self.0.extend([b'K', number]);
        self
    }

    pub(crate) fn raw(mut self, bytes: &[u8]) -> Pickle {
        self.0.extend(bytes);
        self
    }

    /// `numpy.core.multiarray._reconstruct(ndarray, (0,), b'b')` and its state.
    pub(crate) fn array(self, shape: &[u8], values: &[f64]) -> Pickle {
        let mut pickle = self
            .raw(b"cnumpy.core.multiarray\n_reconstruct\n")
            .raw(b"cnumpy\nndarray\nK\x00\x85C\x01b\x87R(K\x01(");
        for &length in shape {
            pickle = pickle.integer(length);
        }
        let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        let mut pickle = pickle
            .raw(b"tcnumpy\ndtype\nX\x02\x00\x00\x00f8K\x00K\x01\x87R(K\x03X\x01\x00\x00\x00<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89");
        pickle.0.push(b'B');
        pickle.0.extend((bytes.len() as u32).to_le_bytes());
        pickle.0.extend(bytes);
        pickle.raw(b"tb")
    }

    /// The bytes of the file.
    pub(crate) fn into_file(self) -> Vec<u8> {
        [&b"\x80\x03"[..], &self.0, b"."].concat()
    }
}
