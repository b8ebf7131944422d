// Sparse convolution and its weight gradient on AMX tiles: operands rounded to bf16, sums in f32.
#pragma once
#include <asm/prctl.h>
#include <sys/syscall.h>
#include <unistd.h>

namespace amx {

// Linux grants the tile registers to a process that asks for them.
inline bool granted() {
  static const bool answer = syscall(SYS_arch_prctl, 0x1023 /* ARCH_REQ_XCOMP_PERM */, 18 /* XTILEDATA */) == 0;
  return answer;
}

struct alignas(64) Config {
  uint8_t palette = 1, start = 0, reserved[14] = {};
  uint16_t bytes[16] = {};
  uint8_t rows[16] = {};
  Config() {
    std::fill(bytes, bytes + 8, 64);
    std::fill(rows, rows + 8, 16);
  }
};

// Tiles of one thread, all 16 rows of 64 bytes, for as long as it lives.
struct Tiles {
  Tiles() {
    const Config c;
    asm volatile("ldtilecfg %0" ::"m"(c));
  }
  ~Tiles() { asm volatile("tilerelease"); }
  Tiles(const Tiles&) = delete;
};

template <int T>
inline void zero() {
  asm volatile("tilezero %%tmm%c0" ::"i"(T));
}
template <int T>
inline void load(const void* p, int64_t stride) {
  asm volatile("tileloadd (%1,%2,1), %%tmm%c0" ::"i"(T), "r"(p), "r"(stride) : "memory");
}
template <int T>
inline void store(void* p, int64_t stride) {
  asm volatile("tilestored %%tmm%c0, (%1,%2,1)" ::"i"(T), "r"(p), "r"(stride) : "memory");
}
template <int C, int A, int B>
inline void multiply() {
  asm volatile("tdpbf16ps %%tmm%c2, %%tmm%c1, %%tmm%c0" ::"i"(C), "i"(A), "i"(B));
}

template <int N, int I = 0, class F>
inline void unrolled(const F& f) {
  if constexpr (I < N) {
    f(std::integral_constant<int, I>());
    unrolled<N, I + 1>(f);
  }
}

inline __mmask16 first_lanes(int64_t count) { return count >= 16 ? 0xffff : count > 0 ? __mmask16((1u << count) - 1) : 0; }

inline uint16_t* allocate(int64_t n) { return static_cast<uint16_t*>(std::aligned_alloc(64, (n * 2 + 63) / 64 * 64)); }

// Rows in bf16, a fraction or a multiple of 32 channels wide, zero beyond the last channel; row -1 is zero and stands for an absent neighbour.
struct Rows {
  uint16_t* p;
  int64_t stride;
  static int64_t front(int64_t stride) { return std::max<int64_t>(32, stride); }
  static int64_t size(int64_t n, int64_t stride) { return front(stride) + (n + 1) * stride + 32; }
  // `memory`: size(n, stride) numbers, 64-byte aligned.
  Rows(uint16_t* memory, int64_t n, int64_t stride_) : p(memory + front(stride_)), stride(stride_) {
    std::fill(memory, p, uint16_t(0));
    std::fill(p + n * stride, memory + size(n, stride), uint16_t(0));
  }
  Rows(const uint16_t* memory, int64_t stride_) : p(const_cast<uint16_t*>(memory) + front(stride_)), stride(stride_) {}
  const uint16_t* row(int64_t i) const { return p + i * stride; }
  void set(int64_t i, const float* x, int64_t c) {
    const int64_t step = std::min<int64_t>(16, stride);
    for (int64_t j = 0; j < stride; j += step) {
      const __m256i h = (__m256i)_mm512_cvtneps_pbh(_mm512_maskz_loadu_ps(first_lanes(std::min(c - j, step)), x + j));
      if (step == 16) _mm256_storeu_si256(reinterpret_cast<__m256i*>(p + i * stride + j), h);
      else _mm_storeu_si128(reinterpret_cast<__m128i*>(p + i * stride + j), _mm256_castsi256_si128(h));
    }
  }
};

inline uint16_t to_bf16(float v) {
  uint32_t u;
  std::memcpy(&u, &v, 4);
  return uint16_t((u + 0x7fff + ((u >> 16) & 1)) >> 16);
}

inline float from_bf16(uint16_t v) {
  const uint32_t u = uint32_t(v) << 16;
  float f;
  std::memcpy(&f, &u, 4);
  return f;
}

// How inputs fill the 32 columns of a tile: channels padded to 8, 16 or a multiple of 32; narrow ones share a tile with other taps.
struct Packing {
  int64_t taps, cin, wide, together, tiles;  // tiles: along the sum
  Packing(int64_t taps_, int64_t cin_) : taps(taps_), cin(cin_) {
    wide = cin <= 8 && taps >= 4 ? 8 : cin <= 16 && taps >= 2 ? 16 : (cin + 31) / 32 * 32;
    together = wide < 32 ? 32 / wide : 1;
    tiles = wide < 32 ? (taps + together - 1) / together : taps * (wide / 32);
  }
};

// Weights as [tile along the sum][panel of 16 outputs][pair of inputs][16 outputs][2 inputs].
inline void pack(const Packing& s, const float* w, int64_t cout, bool transpose, uint16_t* out) {
  const int64_t panels = (cout + 15) / 16;
  std::fill(out, out + s.tiles * panels * 512, uint16_t(0));
#pragma omp parallel for schedule(static)
  for (int64_t k = 0; k < s.taps; k++)
    for (int64_t c = 0; c < s.cin; c++) {
      const int64_t at = k % s.together * s.wide + c, tile = s.wide < 32 ? k / s.together : k * (s.wide / 32) + c / 32;
      uint16_t* to = out + tile * panels * 512 + at % 32 / 2 * 32 + at % 2;
      const float* from = transpose ? w + k * cout * s.cin + c : w + (k * s.cin + c) * cout;
      const int64_t step = transpose ? s.cin : 1;
      for (int64_t o = 0; o < cout; o++) to[o / 16 * 512 + o % 16 * 2] = to_bf16(from[o * step]);
    }
}

// Sums of squared weights per tap and output as three bf16 terms, whose sum is exact: [term][panel][pair of taps][16][2].
inline void pack_squares(const float* squares, int64_t taps, int64_t wide, uint16_t* out) {
  const int64_t panels = wide / 16;
  std::fill(out, out + 3 * panels * 512, uint16_t(0));
  for (int64_t k = 0; k < taps; k++)
    for (int64_t o = 0; o < wide; o++) {
      float rest = squares[k * wide + o];
      for (int64_t term = 0; term < 3; term++) {
        const uint16_t h = to_bf16(rest);
        out[(term * panels + o / 16) * 512 + k / 2 * 32 + o % 16 * 2 + k % 2] = h;
        rest -= from_bf16(h);
      }
    }
}

// Which taps of 16 rows exist, one word a row; rows beyond `left` have none.
inline void masks(const int32_t* map, int64_t n, int64_t taps, int64_t left, uint32_t* out) {
  const __mmask16 in = first_lanes(left);
  __m512i m = _mm512_setzero_si512();
  for (int64_t k = 0; k < taps; k++) {
    const __mmask16 here = _mm512_mask_cmpge_epi32_mask(in, _mm512_maskz_loadu_epi32(in, map + k * n), _mm512_setzero_si512());
    m = _mm512_mask_or_epi32(m, here, m, _mm512_set1_epi32(1 << k));
  }
  _mm512_storeu_si512(out, m);
}

// Sixteen rows of one tile along the sum.
inline void gather(const Packing& s, const Rows& x, const int32_t* map, int64_t n, int64_t left, int64_t tile, uint16_t* a) {
  alignas(64) int32_t rows[16];
  const __mmask16 in = first_lanes(left);
  auto take = [&](int64_t k) { _mm512_store_si512(rows, _mm512_mask_loadu_epi32(_mm512_set1_epi32(-1), in, map + k * n)); };
  if (s.wide >= 32) {
    const int64_t per = s.wide / 32;
    take(tile / per);
    const uint16_t* base = x.p + tile % per * 32;
    // Row -1 of a wide array: every part of it is zero, for the front is `stride` long.
    for (int r = 0; r < 16; r++) _mm512_store_si512(a + 32 * r, _mm512_loadu_si512(base + rows[r] * x.stride));
  } else {
    for (int64_t t = 0; t < s.together; t++) {
      const int64_t k = tile * s.together + t;
      if (k < s.taps) take(k);
      else _mm512_store_si512(rows, _mm512_set1_epi32(-1));
      if (s.wide == 16)
        for (int r = 0; r < 16; r++)
          _mm256_store_si256(reinterpret_cast<__m256i*>(a + 32 * r + 16 * t), _mm256_loadu_si256(reinterpret_cast<const __m256i*>(x.row(rows[r]))));
      else
        for (int r = 0; r < 16; r++)
          _mm_store_si128(reinterpret_cast<__m128i*>(a + 32 * r + 8 * t), _mm_loadu_si128(reinterpret_cast<const __m128i*>(x.row(rows[r]))));
    }
  }
}

// R groups of 16 rows by P panels, R * P <= 4: y[16 R][16 P] = sum over tiles of gathered x times w. `some`: taps that exist in each group.
template <int R, int P>
void rows_by_panels(const Packing& s, const Rows& x, const int32_t* map, int64_t n, int64_t left, const uint32_t* some, const uint16_t* w, int64_t panels,
                    float* y, uint16_t* a) {
  unrolled<R * P>([](auto c) { zero<c>(); });
  uint32_t any = 0;
  for (int r = 0; r < R; r++) any |= some[r];
  for (int64_t t = 0; t < s.tiles; t++) {
    const uint32_t bits = s.wide >= 32 ? 1u << (t / (s.wide / 32)) : ((1u << s.together) - 1) << (t * s.together);
    if (!(any & bits)) continue;
    uint16_t* to = a + t % 4 * (R * 512);
    for (int r = 0; r < R; r++)
      if (some[r] & bits) gather(s, x, map + 16 * r, n, left - 16 * r, t, to + r * 512);
    const uint16_t* b = w + t * panels * 512;
    if constexpr (P >= R) {
      unrolled<R>([&](auto r) { if (some[r] & bits) load<4 + r>(to + r * 512, 64); });
      unrolled<P>([&](auto p) {
        constexpr int B = 6 + p % 2;
        load<B>(b + p * 512, 64);
        unrolled<R>([&](auto r) { if (some[r] & bits) multiply<r * P + p, 4 + r, B>(); });
      });
    } else {  // one panel: its tile stays, rows take turns
      load<7>(b, 64);
      unrolled<R>([&](auto r) {
        if (some[r] & bits) {
          constexpr int A = 4 + r % 3;
          load<A>(to + r * 512, 64);
          multiply<r, A, 7>();
        }
      });
    }
  }
  unrolled<R * P>([&](auto c) { store<c>(y + c / P * 16 * (P * 16) + c % P * 16, P * 64); });
}

// den[16][16 P]: sums of squared weights of the taps that exist.
template <int P>
void denominators(const uint32_t* mask, const uint16_t* squares, int64_t panels, float* den, uint16_t* a) {
  for (int r = 0; r < 16; r++) _mm512_store_si512(a + 32 * r, _mm512_maskz_set1_epi16(mask[r], 0x3f80));
  load<4>(a, 64);
  unrolled<P>([&](auto p) {
    zero<p>();
    for (int term = 0; term < 3; term++) {
      load<6>(squares + (term * panels + p) * 512, 64);
      multiply<p, 4, 6>();
    }
    store<p>(den + p * 16, P * 64);
  });
}

struct Shape {
  int64_t n, cout, panels;
  const float *bias, *gain;
  bool relu;
  float *y, *hat, *inv;
};

// Rows r0 .. of one group of panels (first ..): bias, norm and ReLU on the way out.
template <int R, int P>
void block(const Packing& s, const Rows& x, const int32_t* map, const Shape& o, int64_t r0, int64_t first, const uint16_t* w, const uint16_t* squares) {
  alignas(64) float y[R * P * 256], den[P * 256];
  alignas(64) uint16_t a[4 * R * 512];
  alignas(64) uint32_t mask[R][16], some[R];
  const int64_t left = o.n - r0;
  for (int r = 0; r < R; r++) {
    masks(map + r0 + 16 * r, o.n, s.taps, left - 16 * r, mask[r]);
    some[r] = _mm512_reduce_or_epi32(_mm512_load_si512(mask[r]));
  }
  rows_by_panels<R, P>(s, x, map + r0, o.n, left, some, w + first * 512, o.panels, y, a);
  for (int r = 0; r < R; r++) {
    if (left <= 16 * r) break;
    if (o.gain) denominators<P>(mask[r], squares + first * 512, o.panels, den, a);
    for (int64_t i = 0; i < std::min<int64_t>(16, left - 16 * r); i++)
      for (int p = 0; p < P; p++) {
        const int64_t o0 = (first + p) * 16, width = std::min<int64_t>(16, o.cout - o0), at = (r0 + 16 * r + i) * o.cout + o0;
        const __mmask16 m = first_lanes(width);
        __m512 v = _mm512_load_ps(y + ((16 * r + i) * P + p) * 16);
        if (o.gain) {
          const __m512 d = _mm512_add_ps(_mm512_load_ps(den + (i * P + p) * 16), _mm512_set1_ps(1e-8f));
          const __m512 q = _mm512_div_ps(_mm512_set1_ps(1.f), _mm512_sqrt_ps(d));
          v = _mm512_mul_ps(v, q);
          _mm512_mask_storeu_ps(o.inv + at, m, q);
          _mm512_mask_storeu_ps(o.hat + at, m, v);
          v = _mm512_mul_ps(v, _mm512_maskz_loadu_ps(m, o.gain + o0));
        }
        if (o.bias) v = _mm512_add_ps(v, _mm512_maskz_loadu_ps(m, o.bias + o0));
        if (o.relu) v = _mm512_max_ps(v, _mm512_setzero_ps());
        _mm512_mask_storeu_ps(o.y + at, m, v);
      }
  }
}

inline void convolve(const Rows& rows, int64_t cin, const float* w, bool transpose, const int32_t* map, int64_t taps, const float* squares, Shape o) {
  const Packing s(taps, cin);
  uint16_t *packed = allocate(s.tiles * o.panels * 512), *sq = allocate(3 * o.panels * 512);
  pack(s, w, o.cout, transpose, packed);
  if (o.gain) pack_squares(squares, taps, o.panels * 16, sq);
  const int64_t step = o.panels == 1 ? 64 : o.panels == 2 ? 32 : 16;
  const int64_t blocks = (o.n + step - 1) / step;
#pragma omp parallel
  {
    const Tiles tiles;
#pragma omp for schedule(dynamic, 16)
    for (int64_t b = 0; b < blocks; b++)
      for (int64_t first = 0; first < o.panels; first += 4) {
        const int64_t r0 = b * step;
        if (step == 64) block<4, 1>(s, rows, map, o, r0, first, packed, sq);
        else if (step == 32) block<2, 2>(s, rows, map, o, r0, first, packed, sq);
        else switch (o.panels - first) {
          case 1: block<1, 1>(s, rows, map, o, r0, first, packed, sq); break;
          case 2: block<1, 2>(s, rows, map, o, r0, first, packed, sq); break;
          case 3: block<1, 3>(s, rows, map, o, r0, first, packed, sq); break;
          default: block<1, 4>(s, rows, map, o, r0, first, packed, sq); break;
        }
      }
  }
  std::free(packed);
  std::free(sq);
}

// Two rows of 16 channels, element by element, side by side.
inline void interleave(const uint16_t* a, const uint16_t* b, uint16_t* to) {
  const __m512i lo = _mm512_cvtepu16_epi32(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(a)));
  const __m512i hi = _mm512_cvtepu16_epi32(_mm256_loadu_si256(reinterpret_cast<const __m256i*>(b)));
  _mm512_store_si512(to, _mm512_or_si512(lo, _mm512_slli_epi32(hi, 16)));
}

// R output panels by C input panels of dw[k]^T (+)= sum over groups of 32 rows of g^T x.
template <int R, int C>
void outer(const uint16_t* gt, int64_t gp, const uint16_t* xs, int64_t xp, const uint8_t* there, int64_t groups, float* dw, int64_t stride) {
  unrolled<R * C>([&](auto t) { load<t>(dw + t / C * 16 * stride + t % C * 16, stride * 4); });
  for (int64_t q = 0; q < groups; q++) {
    if (!there[q]) continue;
    unrolled<R>([&](auto r) { load<4 + r>(gt + (q * gp + r) * 512, 64); });
    unrolled<C>([&](auto c) {
      load<6 + c>(xs + (q * xp + c) * 512, 64);
      unrolled<R>([&](auto r) { multiply<r * C + c, 4 + r, 6 + c>(); });
    });
  }
  unrolled<R * C>([&](auto t) { store<t>(dw + t / C * 16 * stride + t % C * 16, stride * 4); });
}

// dw[k][in][out] = sum over rows i of x[map[k][i]][in] g[i][out].
inline void weight_gradient(const Rows& xr, int64_t cin, const Rows& gr, int64_t cout, const int32_t* map, int64_t taps, int64_t n, float* dw) {
  constexpr int64_t CHUNK = 512, GROUPS = CHUNK / 32, SHARES = 4;
  // Rows of 8 channels are read as 16: what the next row lends ends in columns that nobody looks at.
  const int64_t xp = (cin + 15) / 16, gp = (cout + 15) / 16, wide = xp * 16, size = wide * gp * 16;
  float* sums = static_cast<float*>(std::aligned_alloc(64, SHARES * taps * size * 4));
  const int64_t chunks = (n + CHUNK - 1) / CHUNK;
#pragma omp parallel
  {
    const Tiles tiles;
    uint16_t *gt = allocate(GROUPS * gp * 512), *xs = allocate(GROUPS * xp * 512);
    uint8_t there[GROUPS];
#pragma omp for schedule(dynamic, 1)
    for (int64_t share = 0; share < SHARES; share++) {
      float* mine = sums + share * taps * size;
      std::fill(mine, mine + taps * size, 0.f);
      for (int64_t chunk = chunks * share / SHARES; chunk < chunks * (share + 1) / SHARES; chunk++) {
        const int64_t r0 = chunk * CHUNK, groups = (std::min(CHUNK, n - r0) + 31) / 32;
        for (int64_t q = 0; q < groups; q++)  // the transpose of g, a tile of 16 outputs by 32 rows at a time
          for (int64_t p = 0; p < gp; p++) {
            alignas(64) uint32_t pairs[16][16];  // [pair of rows][output]
            for (int64_t j = 0; j < 16; j++) {
              const int64_t i = r0 + 32 * q + 2 * j;
              interleave(gr.row(std::min(i, n)) + 16 * p, gr.row(std::min(i + 1, n)) + 16 * p, reinterpret_cast<uint16_t*>(pairs[j]));
            }
            uint32_t* to = reinterpret_cast<uint32_t*>(gt + (q * gp + p) * 512);
            for (int64_t o = 0; o < 16; o++)
              for (int64_t j = 0; j < 16; j++) to[o * 16 + j] = pairs[j][o];
          }
        for (int64_t k = 0; k < taps; k++) {
          const int32_t* mk = map + k * n + r0;
          for (int64_t q = 0; q < groups; q++) {
            alignas(64) int32_t rows[32];
            for (int64_t h = 0; h < 2; h++) {
              const int64_t left = n - r0 - 32 * q - 16 * h;
              const __mmask16 in = first_lanes(left);
              _mm512_store_si512(rows + 16 * h, _mm512_mask_loadu_epi32(_mm512_set1_epi32(-1), in, mk + 32 * q + 16 * h));
            }
            const __m512i both = _mm512_and_si512(_mm512_load_si512(rows), _mm512_load_si512(rows + 16));
            there[q] = _mm512_cmpge_epi32_mask(both, _mm512_setzero_si512()) != 0;
            if (!there[q]) continue;
            for (int64_t j = 0; j < 16; j++) {
              const uint16_t *a = xr.row(rows[2 * j]), *b = xr.row(rows[2 * j + 1]);
              for (int64_t p = 0; p < xp; p++) interleave(a + 16 * p, b + 16 * p, xs + (q * xp + p) * 512 + j * 32);
            }
          }
          for (int64_t o = 0; o < gp; o += 2)
            for (int64_t c = 0; c < xp; c += 2) {
              const uint16_t *ga = gt + o * 512, *xa = xs + c * 512;
              float* to = mine + k * size + o * 16 * wide + c * 16;
              const bool tall = o + 1 < gp, broad = c + 1 < xp;
              if (tall && broad) outer<2, 2>(ga, gp, xa, xp, there, groups, to, wide);
              else if (tall) outer<2, 1>(ga, gp, xa, xp, there, groups, to, wide);
              else if (broad) outer<1, 2>(ga, gp, xa, xp, there, groups, to, wide);
              else outer<1, 1>(ga, gp, xa, xp, there, groups, to, wide);
            }
        }
      }
    }
    std::free(gt);
    std::free(xs);
  }
#pragma omp parallel for schedule(static)
  for (int64_t k = 0; k < taps; k++)
    for (int64_t c = 0; c < cin; c++)
      for (int64_t o = 0; o < cout; o++) {
        float sum = 0;
        for (int64_t share = 0; share < SHARES; share++) sum += sums[(share * taps + k) * size + o * wide + c];
        dw[(k * cin + c) * cout + o] = sum;
      }
  std::free(sums);
}

}  // namespace amx
