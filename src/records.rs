//! Rows of bytes of one length, as LAS files and binary PLY files hold them: coordinates out, colours in.
//!
//! The rows are never taken apart into columns: what nobody asked for is moved as bytes and so stays as it is.

use rayon::prelude::*;

use crate::{Error, Result};

/// Rows that one task works on: long enough to hide the scheduling, short enough to stay in cache.
const BLOCK: usize = 8192;

/// Number of rows in `bytes`, which must be whole rows of `length` bytes.
fn rows(bytes: &[u8], length: usize, name: &str) -> Result<usize> {
    if length == 0 || !bytes.len().is_multiple_of(length) {
        return Err(Error::invalid(format!("{name}: {} bytes are not whole rows of {length} bytes", bytes.len())));
    }
    Ok(bytes.len() / length)
}

/// Coordinates of LAS point records: `integer * scale + offset`, the integers being the first twelve bytes of each row.
pub fn scaled_xyz(
    records: &[u8],
    length: usize,
    scale: [f64; 3],
    offset: [f64; 3],
    xyz: &mut [[f64; 3]],
) -> Result<()> {
    let n = rows(records, length, "records")?;
    if length < 12 || n != xyz.len() {
        return Err(Error::invalid(format!("{n} records of {length} bytes do not give {} coordinates", xyz.len())));
    }
    records.par_chunks(length * BLOCK).zip(xyz.par_chunks_mut(BLOCK)).for_each(|(records, xyz)| {
        for (record, xyz) in records.chunks_exact(length).zip(xyz) {
            let (integers, _) = record.as_chunks::<4>();
            for axis in 0..3 {
                // Multiply and add apart, as every other reader does: a fused operation would differ in the last bit.
                xyz[axis] = f64::from(i32::from_le_bytes(integers[axis])) * scale[axis] + offset[axis];
            }
        }
    });
    Ok(())
}

/// Values to be put at byte `at` of every row: `width` bytes for each.
#[derive(Debug, Clone, Copy)]
pub struct Column<'a> {
    /// Position in the new row.
    pub at: usize,
    /// Bytes for each row.
    pub width: usize,
    /// The values, row after row.
    pub values: &'a [u8],
}

/// Copies `records` into longer or equal rows: `gap` zero bytes are opened at byte `split`, the new row is filled up with
/// zeros at its end, and the columns are written over the result.
pub fn patch(
    records: &[u8],
    length: usize,
    split: usize,
    gap: usize,
    columns: &[Column<'_>],
    new_length: usize,
    out: &mut [u8],
) -> Result<()> {
    let n = rows(records, length, "records")?;
    if split > length || new_length < length + gap || n * new_length != out.len() {
        return Err(Error::invalid(format!(
            "{n} rows of {length} bytes with {gap} more at byte {split} do not make {} bytes of rows of {new_length}",
            out.len()
        )));
    }
    for column in columns {
        if column.at + column.width > new_length || column.values.len() != n * column.width {
            return Err(Error::invalid(format!(
                "{} bytes for {} bytes at byte {} of {n} rows of {new_length} bytes",
                column.values.len(),
                column.width,
                column.at
            )));
        }
    }
    // The end of the new row need not be cleared where columns cover it; they may not overlap to be counted on for that.
    let mut places: Vec<(usize, usize)> = columns.iter().map(|c| (c.at, c.at + c.width)).collect();
    places.sort_unstable();
    let start = if split == length { length } else { length + gap };
    let covered = places.iter().fold(start, |to, &(at, end)| if at <= to { to.max(end) } else { to }) >= new_length;
    records.par_chunks(length * BLOCK).zip(out.par_chunks_mut(new_length * BLOCK)).enumerate().for_each(
        |(block, (records, out))| {
            if gap == 0 || split == length {
                widen(records, length, out, new_length, !covered);
            } else {
                let end = length + gap;
                for (old, new) in records.chunks_exact(length).zip(out.chunks_exact_mut(new_length)) {
                    new[..split].copy_from_slice(&old[..split]);
                    new[split..split + gap].fill(0);
                    new[split + gap..end].copy_from_slice(&old[split..]);
                    new[end..].fill(0);
                }
            }
            for column in columns {
                let width = column.width;
                let values = &column.values[block * BLOCK * width..];
                match width {
                    2 => scatter::<2>(out, new_length, column.at, values),
                    4 => scatter::<4>(out, new_length, column.at, values),
                    6 => scatter::<6>(out, new_length, column.at, values),
                    0 => {}
                    _ => {
                        for (row, value) in out.chunks_exact_mut(new_length).zip(values.chunks_exact(width)) {
                            row[column.at..column.at + width].copy_from_slice(value);
                        }
                    }
                }
            }
        },
    );
    Ok(())
}

/// Copies rows to the start of longer ones. Lengths known to the compiler are copied without a call for each row.
fn widen(old: &[u8], length: usize, new: &mut [u8], new_length: usize, clear: bool) {
    fn fixed<const L: usize>(old: &[u8], new: &mut [u8], new_length: usize) {
        for (old, new) in old.as_chunks::<L>().0.iter().zip(new.chunks_exact_mut(new_length)) {
            new[..L].copy_from_slice(old);
        }
    }
    match length {
        // The records of LAS without extra bytes, and with those of a first colouring; coordinates or colours alone.
        6 => fixed::<6>(old, new, new_length),
        12 => fixed::<12>(old, new, new_length),
        20 => fixed::<20>(old, new, new_length),
        24 => fixed::<24>(old, new, new_length),
        26 => fixed::<26>(old, new, new_length),
        28 => fixed::<28>(old, new, new_length),
        30 => fixed::<30>(old, new, new_length),
        32 => fixed::<32>(old, new, new_length),
        34 => fixed::<34>(old, new, new_length),
        36 => fixed::<36>(old, new, new_length),
        38 => fixed::<38>(old, new, new_length),
        40 => fixed::<40>(old, new, new_length),
        42 => fixed::<42>(old, new, new_length),
        _ => {
            for (old, new) in old.chunks_exact(length).zip(new.chunks_exact_mut(new_length)) {
                new[..length].copy_from_slice(old);
            }
        }
    }
    if clear {
        for row in new.chunks_exact_mut(new_length) {
            row[length..].fill(0);
        }
    }
}

/// Writes values of a width known to the compiler into rows: twice as fast as the general case.
fn scatter<const W: usize>(out: &mut [u8], length: usize, at: usize, values: &[u8]) {
    for (row, value) in out.chunks_exact_mut(length).zip(values.as_chunks::<W>().0) {
        row[at..at + W].copy_from_slice(value);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn coordinates_are_the_integers_scaled_and_shifted() {
        let mut records = Vec::new();
        for i in 0..20_000i32 {
            for v in [i, -i, i32::MAX - i] {
                records.extend_from_slice(&v.to_le_bytes());
            }
            records.extend_from_slice(&[7; 8]);
        }
        let (scale, offset) = ([0.001, 0.01, 1e-7], [500_000.0, -3.5, 1e3]);
        let mut xyz = vec![[0.0; 3]; 20_000];
        scaled_xyz(&records, 20, scale, offset, &mut xyz).unwrap();
        for (i, p) in xyz.iter().enumerate() {
            let i = i as i32;
            let wanted = [i, -i, i32::MAX - i].map(f64::from);
            for axis in 0..3 {
                assert_eq!(p[axis].to_bits(), (wanted[axis] * scale[axis] + offset[axis]).to_bits());
            }
        }
    }

    #[test]
    fn wrong_sizes_are_refused() {
        assert!(scaled_xyz(&[0; 41], 20, [1.0; 3], [0.0; 3], &mut [[0.0; 3]; 2]).is_err());
        assert!(scaled_xyz(&[0; 40], 20, [1.0; 3], [0.0; 3], &mut [[0.0; 3]; 3]).is_err());
        assert!(scaled_xyz(&[0; 16], 8, [1.0; 3], [0.0; 3], &mut [[0.0; 3]; 2]).is_err());
        assert!(scaled_xyz(&[], 0, [1.0; 3], [0.0; 3], &mut []).is_err());
        assert!(patch(&[0; 40], 20, 21, 0, &[], 20, &mut [0; 40]).is_err());
        assert!(patch(&[0; 40], 20, 10, 6, &[], 25, &mut [0; 50]).is_err());
        let column = Column { at: 18, width: 4, values: &[0; 8] };
        assert!(patch(&[0; 40], 20, 20, 0, &[column], 20, &mut [0; 40]).is_err());
        let column = Column { at: 16, width: 4, values: &[0; 7] };
        assert!(patch(&[0; 40], 20, 20, 0, &[column], 20, &mut [0; 40]).is_err());
    }

    proptest! {
        #[test]
        fn a_patched_row_is_what_it_says(
            n in 0usize..50,
            length in 1usize..40,
            split in 0usize..40,
            gap in 0usize..9,
            extra in 0usize..9,
            width in 0usize..9,
            at in 0usize..60,
            seed in any::<u8>(),
        ) {
            let (split, new_length) = (split.min(length), length + gap + extra);
            let width = width.min(new_length);
            let at = at.min(new_length - width);
            let records: Vec<u8> = (0..n * length).map(|i| (i as u8).wrapping_mul(31).wrapping_add(seed)).collect();
            let values: Vec<u8> = (0..n * width).map(|i| (i as u8).wrapping_mul(17)).collect();
            let mut out = vec![0xAA; n * new_length];
            patch(&records, length, split, gap, &[Column { at, width, values: &values }], new_length, &mut out).unwrap();
            for i in 0..n {
                let old = &records[i * length..(i + 1) * length];
                let mut wanted = old[..split].to_vec();
                wanted.extend(vec![0; gap]);
                wanted.extend(&old[split..]);
                wanted.extend(vec![0; extra]);
                wanted[at..at + width].copy_from_slice(&values[i * width..(i + 1) * width]);
                prop_assert_eq!(&out[i * new_length..(i + 1) * new_length], &wanted[..]);
            }
        }
    }
}
