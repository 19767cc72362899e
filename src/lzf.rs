//! LZF, the compression of `binary_compressed` PCD files: a byte stream of literal runs and back references.
//!
//! A control byte below 32 is followed by that many plus one literal bytes. Otherwise its upper three bits are a length
//! (7: one more byte is added to it) and its lower five the high bits of a distance, whose low byte follows: `length + 2`
//! bytes are repeated from `distance + 1` bytes back, overlapping where the distance is the shorter.

use crate::{Error, Result};

/// The most that one compressed byte can become: three bytes of a back reference stand for 264.
pub const MAX_RATIO: usize = 88;

/// Decompresses `input` into exactly `size` bytes.
///
/// # Errors
/// [`Error::InvalidInput`] when the stream ends early, refers to bytes before its start, or holds more or less than `size`
/// bytes. Never allocates more than the input can hold.
pub fn decompress(input: &[u8], size: usize) -> Result<Vec<u8>> {
    if size > input.len().saturating_mul(MAX_RATIO) {
        return Err(Error::invalid(format!("{} compressed bytes cannot hold {size} bytes", input.len())));
    }
    let broken = |what: &str, out: &Vec<u8>| Err(Error::invalid(format!("{what} after {} of {size} bytes", out.len())));
    let mut out: Vec<u8> = Vec::with_capacity(size);
    let mut rest = input;
    while let [control, tail @ ..] = rest {
        rest = tail;
        if *control < 32 {
            let run = usize::from(*control) + 1;
            let Some((literals, tail)) = rest.split_at_checked(run) else {
                return broken("the compressed data end inside a run", &out);
            };
            if out.len() + run > size {
                return broken("the compressed data go on", &out);
            }
            out.extend_from_slice(literals);
            rest = tail;
            continue;
        }
        let mut length = usize::from(control >> 5);
        if length == 7 {
            let [more, tail @ ..] = rest else { return broken("the compressed data end inside a length", &out) };
            length += usize::from(*more);
            rest = tail;
        }
        length += 2;
        let [low, tail @ ..] = rest else { return broken("the compressed data end inside a distance", &out) };
        rest = tail;
        let distance = (usize::from(control & 31) << 8) + usize::from(*low) + 1;
        if distance > out.len() {
            return broken("the compressed data refer to bytes before their start", &out);
        }
        if out.len() + length > size {
            return broken("the compressed data go on", &out);
        }
        let start = out.len() - distance;
        if distance >= length {
            out.extend_from_within(start..start + length);
        } else {
            // The copy reads what it has just written: a run of a repeated pattern.
            for i in start..start + length {
                out.push(out[i]);
            }
        }
    }
    if out.len() != size {
        return broken("the compressed data end", &out);
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A plain greedy compressor, written for these tests alone: longest match among the last 8192 bytes.
    fn compress(data: &[u8]) -> Vec<u8> {
        let (mut out, mut literals, mut i) = (Vec::new(), Vec::new(), 0);
        let flush = |literals: &mut Vec<u8>, out: &mut Vec<u8>| {
            for run in literals.chunks(32) {
                out.push(run.len() as u8 - 1);
                out.extend_from_slice(run);
            }
            literals.clear();
        };
        while i < data.len() {
            let best = (i.saturating_sub(8192)..i)
                .map(|s| {
                    let length = data[i..].iter().zip(&data[s..]).take(264).take_while(|(a, b)| a == b).count();
                    (length, s)
                })
                .max()
                .unwrap_or((0, 0));
            if best.0 >= 3 {
                flush(&mut literals, &mut out);
                let (length, distance) = (best.0 - 2, i - best.1 - 1);
                if length < 7 {
                    out.push((length << 5 | distance >> 8) as u8);
                } else {
                    out.push((7 << 5 | distance >> 8) as u8);
                    out.push((length - 7) as u8);
                }
                out.push((distance & 255) as u8);
                i += best.0;
            } else {
                literals.push(data[i]);
                i += 1;
            }
        }
        flush(&mut literals, &mut out);
        out
    }

    #[test]
    fn the_smallest_streams() {
        assert_eq!(decompress(&[], 0).unwrap(), b"");
        assert_eq!(decompress(&[2, b'a', b'b', b'c'], 3).unwrap(), b"abc");
        // One literal, then a reference of length 9 + 2 to distance 1.
        assert_eq!(decompress(&[0, b'x', 7 << 5, 2, 0], 12).unwrap(), b"xxxxxxxxxxxx");
        assert_eq!(decompress(&[1, b'a', b'b', 1 << 5, 1], 5).unwrap(), b"ababa");
    }

    #[test]
    fn broken_streams_are_named() {
        for (stream, size, word) in [
            (&[5u8, 1, 2][..], 6, "inside a run"),
            (&[0, b'x', 7 << 5], 20, "inside a length"),
            (&[0, b'x', 1 << 5], 4, "inside a distance"),
            (&[0, b'x', 1 << 5, 9], 4, "before their start"),
            (&[1, b'a', b'b'], 1, "go on"),
            (&[0, b'x', 7 << 5, 200, 0], 9, "go on"),
            (&[0, b'x'], 2, "end after 1 of 2"),
            (&[0, b'x'], usize::MAX, "cannot hold"),
        ] {
            let message = decompress(stream, size).unwrap_err().to_string();
            assert!(message.contains(word), "{message}");
        }
    }

    proptest! {
        #[test]
        fn what_was_compressed_comes_back(data in prop::collection::vec(0u8..4, 0..3000)) {
            prop_assert_eq!(decompress(&compress(&data), data.len()).unwrap(), data);
        }

        #[test]
        fn any_bytes_and_any_size_end_in_a_word(input in prop::collection::vec(any::<u8>(), 0..400), size in 0usize..50_000) {
            if let Ok(out) = decompress(&input, size) {
                prop_assert_eq!(out.len(), size);
            }
        }
    }
}
