// The yardstick of benchmarks/rasterizer.py: the algorithm of src/compgs/render/{binning,tiles}.py, vectorized by hand.
//
// A vector holds the eight pixels of a tile's row; sums over a splat's pixels stay in registers. Compiled with
// g++ -O3 -march=native -ffast-math -fopenmp. Everything is called from one thread and runs on `threads`.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include <omp.h>

typedef float Floats __attribute__((vector_size(32)));
#ifdef __AVX512F__
constexpr int kWidest = 16;  // floats of the machine's widest register
#else
constexpr int kWidest = 8;
#endif
typedef float Widest __attribute__((vector_size(4 * kWidest)));
typedef int32_t Ints __attribute__((vector_size(32)));

namespace {

constexpr int kTileWidth = 8, kTileHeight = 32, kLanes = kTileWidth;
constexpr int kChunks = 16, kRadixBits = 11, kDigits = 1 << kRadixBits, kBatch = 16, kMoments = 9;
constexpr float kCutoff = 1.0f / 255.0f, kCap = 0.999f, kStop = 1e-4f;
constexpr float kExp2Scale = 0.84932180f, kTwoLn2 = 1.38629436f, kSlack = 0.01f;

const Floats kColumn = {0, 1, 2, 3, 4, 5, 6, 7};

inline Floats splat(float value) { return value - Floats{}; }
inline Floats select(Ints condition, Floats yes, Floats no) { return condition ? yes : no; }
inline Floats smaller(Floats a, Floats b) { return a < b ? a : b; }

inline float sum(Floats v) {
    float total = 0;
    for (int i = 0; i < kLanes; i++) total += v[i];
    return total;
}

// 2^-q, q up to 126; the polynomial of tiles.py.
inline Floats exp2_minus(Floats q) {
    Floats t = -smaller(q, splat(126.0f));
    Ints whole = __builtin_convertvector(t, Ints);                                  // towards zero
    whole += __builtin_convertvector(whole, Floats) > t;                            // floor: a true comparison is -1
    Floats f = t - __builtin_convertvector(whole, Floats);
    Floats p = 0.9999999251f +
               f * (0.6931530732f +
                    f * (0.2401536171f + f * (0.05582631792f + f * (0.008989340252f + f * 0.001877576608f))));
    Ints bits = (whole + 127) << 23;
    Floats power;
    std::memcpy(&power, &bits, sizeof power);
    return p * power;
}

struct Packed {
    float x, y, l00, l10, l11, log2_opacity, red, green, blue;
};
struct Entry {
    int32_t splat, rows;
};

struct Scene {
    int count, width, height, tiles_x, tiles_y;
    std::vector<uint8_t> visible;
    std::vector<int32_t> boxes, slots, rows, first_slot, slots_used;
    std::vector<Packed> packed;
    std::vector<int64_t> starts, ends, counts;
    std::vector<Entry> entries;
    std::vector<uint32_t> keys, sorted_keys;
    std::vector<int32_t> order, sorted_order, digits;
    std::vector<float> moments;
    double binning_seconds;
};
Scene scene;

inline int64_t bound(int chunk, int64_t n) { return chunk * n / kChunks; }

void bin(const float *means, const float *covariances, const float *determinants, const float *depths,
         const float *opacities, const float *colors) {
    Scene &s = scene;
    const int n = s.count;
    const float log2_cutoff = std::log2(kCutoff);
    s.visible.resize(n), s.boxes.resize(4 * n), s.packed.resize(n), s.first_slot.resize(n), s.slots_used.resize(n);
    int64_t found[kChunks], room[kChunks];
#pragma omp parallel for schedule(static)
    for (int chunk = 0; chunk < kChunks; chunk++) {
        int64_t visible = 0, tiles = 0;
        for (int64_t i = bound(chunk, n); i < bound(chunk + 1, n); i++) {
            s.visible[i] = 0;
            if (!(depths[i] < 1e30f && opacities[i] > 0)) continue;
            float log2_opacity = std::log2(opacities[i]), reach = kTwoLn2 * (log2_opacity - log2_cutoff);
            if (!(reach > 0)) continue;
            float hx = std::sqrt(reach * covariances[3 * i]), hy = std::sqrt(reach * covariances[3 * i + 2]);
            float x0 = std::max(std::ceil(means[2 * i] - hx - 0.5f), 0.0f);
            float x1 = std::min(std::floor(means[2 * i] + hx - 0.5f), s.width - 1.0f);
            float y0 = std::max(std::ceil(means[2 * i + 1] - hy - 0.5f), 0.0f);
            float y1 = std::min(std::floor(means[2 * i + 1] + hy - 0.5f), s.height - 1.0f);
            if (x0 > x1 || y0 > y1) continue;
            int32_t *box = &s.boxes[4 * i];
            box[0] = x0, box[1] = x1, box[2] = y0, box[3] = y1;
            tiles += (box[1] / kTileWidth - box[0] / kTileWidth + 1) * (box[3] / kTileHeight - box[2] / kTileHeight + 1);
            s.packed[i].log2_opacity = log2_opacity;
            s.visible[i] = 1;
            visible++;
        }
        found[chunk] = visible, room[chunk] = tiles;
    }
    int64_t all_found = 0, all_room = 0;
    for (int chunk = 0; chunk < kChunks; chunk++) all_found += found[chunk], all_room += room[chunk];
    s.slots.resize(all_room), s.rows.resize(all_room);
    s.keys.resize(all_found), s.order.resize(all_found), s.sorted_keys.resize(all_found), s.sorted_order.resize(all_found);

#pragma omp parallel for schedule(static)
    for (int chunk = 0; chunk < kChunks; chunk++) {
        int64_t slot = 0, rank = 0;
        for (int c = 0; c < chunk; c++) slot += room[c], rank += found[c];
        for (int64_t i = bound(chunk, n); i < bound(chunk + 1, n); i++) {
            if (!s.visible[i]) continue;
            std::memcpy(&s.keys[rank], &depths[i], 4);
            s.order[rank++] = i;
            float x = means[2 * i], y = means[2 * i + 1], det = determinants[i];
            float a = covariances[3 * i], b = covariances[3 * i + 1], c = covariances[3 * i + 2];
            Packed &p = s.packed[i];
            p.x = x, p.y = y;
            p.l00 = kExp2Scale * std::sqrt(c / det), p.l10 = -p.l00 * b / c, p.l11 = kExp2Scale / std::sqrt(c);
            p.red = colors[3 * i], p.green = colors[3 * i + 1], p.blue = colors[3 * i + 2];
            float reach = kTwoLn2 * (p.log2_opacity - log2_cutoff);
            float half_x = std::sqrt(reach * a), top_dx = b * std::sqrt(reach / c), inv_a = 1 / a;
            float slope = b * inv_a, spread = det * inv_a * inv_a, reach_a = reach * a;
            const int32_t *box = &s.boxes[4 * i];
            s.first_slot[i] = slot;
            for (int column = box[0] / kTileWidth; column <= box[1] / kTileWidth; column++) {
                float left = std::max(column * kTileWidth + 0.5f - x, -half_x);
                float right = std::min((column + 1) * kTileWidth - 0.5f - x, half_x);
                float high_dx = std::min(std::max(top_dx, left), right), low_dx = std::min(std::max(-top_dx, left), right);
                float high = slope * high_dx + std::sqrt(std::max(reach_a - high_dx * high_dx, 0.0f) * spread);
                float low = slope * low_dx - std::sqrt(std::max(reach_a - low_dx * low_dx, 0.0f) * spread);
                int row0 = std::max((int)std::ceil(y + low - kSlack - 0.5f), box[2]);
                int row1 = std::min((int)std::floor(y + high + kSlack - 0.5f), box[3]);
                if (row0 > row1) continue;
                for (int row = row0 / kTileHeight; row <= row1 / kTileHeight; row++) {
                    int top = row * kTileHeight;
                    s.slots[slot] = row * s.tiles_x + column;
                    s.rows[slot++] = std::max(row0 - top, 0) * 256 + std::min(row1 - top, kTileHeight - 1);
                }
            }
            s.slots_used[i] = slot - s.first_slot[i];
        }
    }

    uint32_t lowest = ~0u, highest = 0;
    for (uint32_t key : s.keys) lowest = std::min(lowest, key), highest = std::max(highest, key);
    s.digits.resize(kChunks * kDigits);
    for (int shift = 0; all_found && shift < 32 && ((highest - lowest) >> shift); shift += kRadixBits) {
#pragma omp parallel for schedule(static)
        for (int chunk = 0; chunk < kChunks; chunk++) {
            int32_t *digits = &s.digits[chunk * kDigits];
            std::memset(digits, 0, kDigits * 4);
            for (int64_t i = bound(chunk, all_found); i < bound(chunk + 1, all_found); i++)
                digits[((s.keys[i] - lowest) >> shift) & (kDigits - 1)]++;
        }
        int32_t position = 0;
        for (int digit = 0; digit < kDigits; digit++)
            for (int chunk = 0; chunk < kChunks; chunk++) {
                int32_t here = s.digits[chunk * kDigits + digit];
                s.digits[chunk * kDigits + digit] = position;
                position += here;
            }
#pragma omp parallel for schedule(static)
        for (int chunk = 0; chunk < kChunks; chunk++) {
            int32_t *digits = &s.digits[chunk * kDigits];
            for (int64_t i = bound(chunk, all_found); i < bound(chunk + 1, all_found); i++) {
                int32_t to = digits[((s.keys[i] - lowest) >> shift) & (kDigits - 1)]++;
                s.sorted_keys[to] = s.keys[i], s.sorted_order[to] = s.order[i];
            }
        }
        s.keys.swap(s.sorted_keys), s.order.swap(s.sorted_order);
    }

    const int tiles = s.tiles_x * s.tiles_y;
    s.counts.assign(int64_t(kChunks) * tiles, 0);
    s.starts.resize(tiles + 1);
#pragma omp parallel for schedule(static)
    for (int chunk = 0; chunk < kChunks; chunk++)
        for (int64_t r = bound(chunk, all_found); r < bound(chunk + 1, all_found); r++) {
            int32_t i = s.order[r];
            for (int32_t slot = s.first_slot[i]; slot < s.first_slot[i] + s.slots_used[i]; slot++)
                s.counts[int64_t(chunk) * tiles + s.slots[slot]]++;
        }
    int64_t position = 0;
    for (int tile = 0; tile < tiles; tile++) {
        s.starts[tile] = position;
        for (int chunk = 0; chunk < kChunks; chunk++) {
            int64_t here = s.counts[int64_t(chunk) * tiles + tile];
            s.counts[int64_t(chunk) * tiles + tile] = position;
            position += here;
        }
    }
    s.starts[tiles] = position;
    s.entries.resize(position);
#pragma omp parallel for schedule(static)
    for (int chunk = 0; chunk < kChunks; chunk++)
        for (int64_t r = bound(chunk, all_found); r < bound(chunk + 1, all_found); r++) {
            int32_t i = s.order[r];
            for (int32_t slot = s.first_slot[i]; slot < s.first_slot[i] + s.slots_used[i]; slot++) {
                int64_t to = s.counts[int64_t(chunk) * tiles + s.slots[slot]]++;
                s.entries[to] = {i, s.rows[slot]};
                s.slots[slot] = to;
            }
        }
}

void start(Floats *transmittance, int left, int top) {
    float *t = reinterpret_cast<float *>(transmittance);
    for (int row = 0; row < kTileHeight; row++)
        for (int column = 0; column < kTileWidth; column++)
            t[row * kTileWidth + column] = top + row < scene.height && left + column < scene.width ? 1.0f : -1.0f;
}

// Alpha before the cap, and the pixels' step of transmittance.
struct Step {
    Floats uncapped, alpha, weight;
    Ints open;
};

inline Step step(const Packed &p, Floats dx, float dy, Floats &t) {
    Step s;
    Floats u = p.l00 * dx + p.l10 * dy;
    float v = p.l11 * dy;
    s.uncapped = exp2_minus(u * u + (v * v - p.log2_opacity));
    s.alpha = smaller(s.uncapped, splat(kCap));
    s.alpha = select(s.alpha >= kCutoff, s.alpha, Floats{});
    s.weight = s.alpha * t;
    Floats next = t - s.weight;
    s.open = next > kStop;
    s.weight = select(s.open, s.weight, Floats{});
    t = select(s.open, next, select(t < 0, t, -t));
    return s;
}

}  // namespace

extern "C" void yardstick_forward(int threads, int count, int width, int height, const float *means,
                                  const float *covariances, const float *determinants, const float *depths,
                                  const float *opacities, const float *colors, float *image, float *transmittance) {
    omp_set_num_threads(threads);
    Scene &s = scene;
    s.count = count, s.width = width, s.height = height;
    s.tiles_x = (width + kTileWidth - 1) / kTileWidth, s.tiles_y = (height + kTileHeight - 1) / kTileHeight;
    const double begin = omp_get_wtime();
    bin(means, covariances, determinants, depths, opacities, colors);
    s.binning_seconds = omp_get_wtime() - begin;
    s.ends.resize(s.starts.size() - 1);
#pragma omp parallel for schedule(static)
    for (int tile = 0; tile < s.tiles_x * s.tiles_y; tile++) {
        const int left = tile % s.tiles_x * kTileWidth, top = tile / s.tiles_x * kTileHeight;
        Floats t[kTileHeight], red[kTileHeight] = {}, green[kTileHeight] = {}, blue[kTileHeight] = {};
        Packed splats[kBatch];
        start(t, left, top);
        int64_t k = s.starts[tile];
        const int64_t end = s.starts[tile + 1];
        while (k < end) {
            const int64_t check = std::min(k + kBatch, end);
            for (int64_t e = k; e < check; e++) splats[e - k] = s.packed[s.entries[e].splat];
            for (int64_t e = k; e < check; e++) {
                const Packed &p = splats[e - k];
                const Floats dx = p.x - (left + 0.5f) - kColumn;
                const float dy0 = p.y - (top + 0.5f);
                for (int v = s.entries[e].rows >> 8; v <= (s.entries[e].rows & 255); v++) {
                    Step q = step(p, dx, dy0 - v, t[v]);
                    red[v] += q.weight * p.red, green[v] += q.weight * p.green, blue[v] += q.weight * p.blue;
                }
            }
            k = check;
            Ints live = {};
            for (int v = 0; v < kTileHeight; v++) live |= t[v] > 0;
            int any = 0;
            for (int i = 0; i < kLanes; i++) any |= live[i];
            if (!any) break;
        }
        s.ends[tile] = k;
        const float *tp = reinterpret_cast<float *>(t), *rp = reinterpret_cast<float *>(red);
        const float *gp = reinterpret_cast<float *>(green), *bp = reinterpret_cast<float *>(blue);
        for (int row = 0; row < std::min(kTileHeight, height - top); row++)
            for (int column = 0; column < std::min(kTileWidth, width - left); column++) {
                const int pixel = row * kTileWidth + column;
                const int64_t at = int64_t(top + row) * width + left + column;
                image[3 * at] = rp[pixel], image[3 * at + 1] = gp[pixel], image[3 * at + 2] = bp[pixel];
                transmittance[at] = std::fabs(tp[pixel]);
            }
    }
}

extern "C" void yardstick_backward(const float *image, const float *transmittance, const float *grad_image,
                                   const float *grad_transmittance, const float *opacities, float *grad_means,
                                   float *grad_covariances, float *grad_opacities, float *grad_colors) {
    Scene &s = scene;
    s.moments.resize(s.entries.size() * kMoments);
#pragma omp parallel for schedule(static)
    for (int tile = 0; tile < s.tiles_x * s.tiles_y; tile++) {
        const int left = tile % s.tiles_x * kTileWidth, top = tile / s.tiles_x * kTileHeight;
        Floats t[kTileHeight], red[kTileHeight] = {}, green[kTileHeight] = {}, blue[kTileHeight] = {}, behind[kTileHeight] = {};
        Packed splats[kBatch];
        start(t, left, top);
        float *rp = reinterpret_cast<float *>(red), *gp = reinterpret_cast<float *>(green);
        float *bp = reinterpret_cast<float *>(blue), *dp = reinterpret_cast<float *>(behind);
        for (int row = 0; row < std::min(kTileHeight, s.height - top); row++)
            for (int column = 0; column < std::min(kTileWidth, s.width - left); column++) {
                const int pixel = row * kTileWidth + column;
                const int64_t at = int64_t(top + row) * s.width + left + column;
                rp[pixel] = grad_image[3 * at], gp[pixel] = grad_image[3 * at + 1], bp[pixel] = grad_image[3 * at + 2];
                dp[pixel] = rp[pixel] * image[3 * at] + gp[pixel] * image[3 * at + 1] + bp[pixel] * image[3 * at + 2] +
                            grad_transmittance[at] * transmittance[at];
            }
        for (int64_t batch = s.starts[tile]; batch < s.ends[tile]; batch += kBatch) {
            const int64_t batch_end = std::min(batch + kBatch, s.ends[tile]);
            for (int64_t e = batch; e < batch_end; e++) splats[e - batch] = s.packed[s.entries[e].splat];
            for (int64_t e = batch; e < batch_end; e++) {
                const Packed &p = splats[e - batch];
                const Floats dx = p.x - (left + 0.5f) - kColumn;
                const float dy0 = p.y - (top + 0.5f);
                Floats m0 = {}, my = {}, myy = {}, m_red = {}, m_green = {}, m_blue = {};
                for (int v = s.entries[e].rows >> 8; v <= (s.entries[e].rows & 255); v++) {
                    const float dy = dy0 - v;
                    Step q = step(p, dx, dy, t[v]);
                    const Floats color_grad = red[v] * p.red + green[v] * p.green + blue[v] * p.blue;
                    behind[v] -= q.weight * color_grad;
                    Floats g = q.weight * color_grad - q.alpha * behind[v] / (1.0f - q.alpha);
                    g = select(q.open & (q.uncapped <= kCap), g, Floats{});
                    m0 += g, my += g * dy, myy += g * dy * dy;
                    m_red += q.weight * red[v], m_green += q.weight * green[v], m_blue += q.weight * blue[v];
                }
                float *m = &s.moments[e * kMoments];
                m[0] = sum(m0), m[1] = sum(m0 * dx), m[2] = sum(my), m[3] = sum(m0 * dx * dx), m[4] = sum(my * dx);
                m[5] = sum(myy), m[6] = sum(m_red), m[7] = sum(m_green), m[8] = sum(m_blue);
            }
        }
        std::fill(&s.moments[s.ends[tile] * kMoments], &s.moments[0] + s.starts[tile + 1] * kMoments, 0.0f);
    }
#pragma omp parallel for schedule(static)
    for (int chunk = 0; chunk < kChunks; chunk++)
        for (int64_t i = bound(chunk, s.count); i < bound(chunk + 1, s.count); i++) {
            float m[kMoments] = {}, *gm = grad_means + 2 * i, *gc = grad_covariances + 3 * i, *gk = grad_colors + 3 * i;
            gm[0] = gm[1] = gc[0] = gc[1] = gc[2] = gk[0] = gk[1] = gk[2] = grad_opacities[i] = 0;
            if (!s.visible[i]) continue;
            for (int32_t slot = s.first_slot[i]; slot < s.first_slot[i] + s.slots_used[i]; slot++)
                for (int j = 0; j < kMoments; j++) m[j] += s.moments[int64_t(s.slots[slot]) * kMoments + j];
            const Packed &p = s.packed[i];
            const float l00 = p.l00 / kExp2Scale, l10 = p.l10 / kExp2Scale, l11 = p.l11 / kExp2Scale;
            const float wx = l00 * m[1] + l10 * m[2], wy = l11 * m[2];
            const float wxx = l00 * l00 * m[3] + 2 * l00 * l10 * m[4] + l10 * l10 * m[5];
            const float wxy = l11 * (l00 * m[4] + l10 * m[5]), wyy = l11 * l11 * m[5];
            gm[0] = -l00 * wx, gm[1] = -(l10 * wx + l11 * wy);
            gc[0] = 0.5f * l00 * l00 * wxx, gc[1] = l00 * (l10 * wxx + l11 * wxy);
            gc[2] = 0.5f * (l10 * l10 * wxx + 2 * l10 * l11 * wxy + l11 * l11 * wyy);
            grad_opacities[i] = m[0] / opacities[i];
            gk[0] = m[6], gk[1] = m[7], gk[2] = m[8];
        }
}

extern "C" double yardstick_binning_seconds() { return scene.binning_seconds; }

// Billions of floating-point operations a second, all threads together: independent multiply-adds, nothing else.
extern "C" double yardstick_fma(int threads, int64_t rounds) {
    omp_set_num_threads(threads);
    double total = 0;
    const double begin = omp_get_wtime();
#pragma omp parallel for reduction(+ : total)
    for (int thread = 0; thread < threads; thread++) {
        constexpr int kChains = 12;
        Widest chain[kChains], a = {}, b = {};
        a += 0.999999f, b += 1e-6f;
        for (int c = 0; c < kChains; c++) chain[c] = a * (1.0f + 0.01f * c + thread);
        for (int64_t i = 0; i < rounds; i++) {
#pragma GCC unroll 12
            for (int c = 0; c < kChains; c++) {
                chain[c] = chain[c] * a + b;
                asm("" : "+v"(chain[c]));
            }
        }
        for (int c = 0; c < kChains; c++) total += chain[c][0];
    }
    const double seconds = omp_get_wtime() - begin;
    return total == 0.125 ? 0 : 2.0 * kWidest * 12 * rounds * threads / seconds / 1e9;
}
