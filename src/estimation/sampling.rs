//! Random numbers that depend on a seed and a counter alone, so that parallel work draws the same ones at any number of
//! threads.

/// A stream of random numbers. Source: G. Steele et al., Fast splittable pseudorandom number generators, 2014 (SplitMix64).
#[derive(Debug, Clone)]
pub struct Random {
    state: u64,
}

impl Random {
    /// The stream of a seed.
    pub fn new(seed: u64) -> Self {
        Self { state: seed }
    }

    /// The stream of the `counter`-th task of a seed.
    pub fn of_task(seed: u64, counter: u64) -> Self {
        let mut start = Self::new(seed ^ counter.wrapping_mul(0xD134_2543_DE82_EF95));
        let state = start.next_u64() ^ counter;
        Self { state }
    }

    /// 64 random bits.
    pub fn next_u64(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.state;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Uniform in [0, 1).
    pub fn uniform(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// Uniform in 0..n; n must not be zero. The bias of the multiplication is below n / 2⁶⁴.
    pub fn below(&mut self, n: usize) -> usize {
        ((u128::from(self.next_u64()) * n as u128) >> 64) as usize
    }

    /// Standard normal (Box and Muller).
    pub fn normal(&mut self) -> f64 {
        let (u, v) = (1.0 - self.uniform(), self.uniform());
        (-2.0 * u.ln()).sqrt() * (2.0 * std::f64::consts::PI * v).cos()
    }

    /// `N` different indices of 0..n; n must be at least `N`.
    pub fn distinct<const N: usize>(&mut self, n: usize) -> [usize; N] {
        let mut chosen = [usize::MAX; N];
        for i in 0..N {
            chosen[i] = loop {
                let candidate = self.below(n);
                if !chosen[..i].contains(&candidate) {
                    break candidate;
                }
            };
        }
        chosen
    }

    /// A random order of 0..n (Fisher and Yates).
    pub fn permutation(&mut self, n: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..n).collect();
        for i in (1..n).rev() {
            order.swap(i, self.below(i + 1));
        }
        order
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_spread_as_they_should_be() {
        let mut random = Random::new(7);
        let n = 200_000;
        let mut counts = [0usize; 10];
        let (mut sum, mut squares) = (0.0, 0.0);
        for _ in 0..n {
            counts[random.below(10)] += 1;
            let z = random.normal();
            sum += z;
            squares += z * z;
        }
        let expected = n as f64 / 10.0;
        let chi2: f64 = counts.iter().map(|&c| (c as f64 - expected).powi(2) / expected).sum();
        assert!(chi2 < 27.9, "χ² with 9 degrees of freedom: {chi2}");
        assert!((sum / n as f64).abs() < 0.01 && (squares / n as f64 - 1.0).abs() < 0.015);
    }

    #[test]
    fn samples_are_distinct_and_tasks_differ() {
        for task in 0..1000 {
            let [a, b, c] = Random::of_task(5, task).distinct::<3>(4);
            assert!(a != b && b != c && a != c && a.max(b).max(c) < 4);
        }
        assert_ne!(Random::of_task(5, 0).next_u64(), Random::of_task(5, 1).next_u64());
        assert_ne!(Random::of_task(5, 1).next_u64(), Random::of_task(6, 1).next_u64());
        let mut order = Random::new(1).permutation(100);
        assert_ne!(order, (0..100).collect::<Vec<_>>());
        order.sort_unstable();
        assert_eq!(order, (0..100).collect::<Vec<_>>());
    }
}
