/* Reference transport: transient path tracer in float64 from the sensor points of a relay wall.
 *
 * Independent of the product on purpose: no Mitsuba, no Dr.Jit, no shared code. Radiometry: H is the radiance that
 * leaves a sensor point, per joule of pulse, integrated over a bin [J m^-2 sr^-1]; bounce k is the k-th surface
 * interaction between laser and sensor, both wall points included, specular and null ones too.
 *
 * Visibility is decided by what a ray meets first, by identity of the primitive. The only tolerance is RELATIVE
 * rounding of float64 (EPS times the scene's extent, about 1e-11 m): surfaces nearer than that are one surface, of
 * which the primitive of the lowest index is met.
 */
#include <math.h>
#include <pthread.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define PI 3.14159265358979323846
#define EPS 1e-11
#define PRIM 40 /* doubles per primitive */
#define MAT 12  /* doubles per material */
#define MAX_CHAIN 4

typedef struct { double x, y, z; } V;
static V v(double x, double y, double z) { V a = {x, y, z}; return a; }
static V add(V a, V b) { return v(a.x + b.x, a.y + b.y, a.z + b.z); }
static V sub(V a, V b) { return v(a.x - b.x, a.y - b.y, a.z - b.z); }
static V mul(V a, double s) { return v(a.x * s, a.y * s, a.z * s); }
static double dot(V a, V b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static V cross(V a, V b) { return v(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x); }
static double len(V a) { return sqrt(dot(a, a)); }
static V unit(V a) { return mul(a, 1 / len(a)); }
static V at(const double *p) { return v(p[0], p[1], p[2]); }

typedef struct { V s, t, n; } Frame;
static Frame frame(V n) {
    V a = fabs(n.x) < 0.6 ? v(1, 0, 0) : v(0, 1, 0);
    Frame f; f.n = n; f.s = unit(cross(a, n)); f.t = cross(n, f.s);
    return f;
}
static V local(const Frame *f, V w) { return v(dot(w, f->s), dot(w, f->t), dot(w, f->n)); }
static V world(const Frame *f, V w) { return add(add(mul(f->s, w.x), mul(f->t, w.y)), mul(f->n, w.z)); }

typedef struct { uint64_t s; } Rng; /* splitmix64 */
static uint64_t next64(Rng *r) {
    uint64_t z = (r->s += 0x9E3779B97F4A7C15ull);
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9ull; z = (z ^ (z >> 27)) * 0x94D049BB133111EBull;
    return z ^ (z >> 31);
}
static double rnd(Rng *r) { return (double)(next64(r) >> 11) * 0x1p-53; }

/* ---- Scene -------------------------------------------------------------------------------------------------- */
enum { TRIANGLE, SPHERE, CYLINDER };
enum { DIFFUSE, CONDUCTOR, ROUGH, DIELECTRIC, THIN, BLEND, MASK, TWOSIDED, PLASTIC, NULLBSDF };
/* Primitive, kind[4] = {type, material, hidden, has vertex normals}:
 *   triangle  0 p0, 3 e1, 6 e2, 9 n0 n1 n2, 18 uv0 uv1 uv2;  sphere 0 centre, 3 radius, 4 sign;
 *   cylinder  0 base, 3 axis (unit), 6 radius, 7 height, 8 sign.
 * Material, mkind[4] = {type, first child, second child, texture or -1}:
 *   0 reflectance/weight/opacity; conductors 1 eta, 2 k (R = 1 when eta = 0), 3 alpha, 4 beckmann; dielectrics 1 eta;
 *   plastic 1 eta, 5 specular reflectance, 6 nonlinear.
 * Texture, tkind[4] = {offset, width, height, nearest}; row 0 lies at v = 1. */
typedef struct { V lo, hi; int left, right, first, count; } Node;
typedef struct {
    int n_prims, n_mats; const double *prims, *mats; const int *kind, *mkind, *tkind; const double *texels;
    int *order; Node *nodes; int n_nodes; double tmin; double *cdf; double total;
    int (*chains)[1 + 2 * MAX_CHAIN]; int n_chains, cap_chains;
    V *normal; /* of triangles, unit */
} Scene;
typedef struct { int prim; double t; V p, ng; Frame sh; double u, v; int mat; } Hit;

static void bounds(const Scene *s, int i, V *lo, V *hi) {
    const double *q = s->prims + (size_t)PRIM * i;
    V a[8]; int n = 0;
    if (s->kind[4 * i] == TRIANGLE) { a[n++] = at(q); a[n++] = add(at(q), at(q + 3)); a[n++] = add(at(q), at(q + 6)); }
    else if (s->kind[4 * i] == SPHERE) { V r = v(q[3], q[3], q[3]); a[n++] = sub(at(q), r); a[n++] = add(at(q), r); }
    else {
        V r = v(q[6], q[6], q[6]), b = at(q), e = add(b, mul(at(q + 3), q[7]));
        a[n++] = sub(b, r); a[n++] = add(b, r); a[n++] = sub(e, r); a[n++] = add(e, r);
    }
    *lo = *hi = a[0];
    for (int k = 1; k < n; k++) {
        lo->x = fmin(lo->x, a[k].x); lo->y = fmin(lo->y, a[k].y); lo->z = fmin(lo->z, a[k].z);
        hi->x = fmax(hi->x, a[k].x); hi->y = fmax(hi->y, a[k].y); hi->z = fmax(hi->z, a[k].z);
    }
}
static double axis_of(V a, int k) { return k == 0 ? a.x : k == 1 ? a.y : a.z; }

static int build(Scene *s, int first, int count) {
    int id = s->n_nodes++;
    V lo = v(1e300, 1e300, 1e300), hi = v(-1e300, -1e300, -1e300), clo = lo, chi = hi, a, b;
    for (int i = first; i < first + count; i++) {
        bounds(s, s->order[i], &a, &b);
        lo = v(fmin(lo.x, a.x), fmin(lo.y, a.y), fmin(lo.z, a.z));
        hi = v(fmax(hi.x, b.x), fmax(hi.y, b.y), fmax(hi.z, b.z));
        V c = mul(add(a, b), 0.5);
        clo = v(fmin(clo.x, c.x), fmin(clo.y, c.y), fmin(clo.z, c.z));
        chi = v(fmax(chi.x, c.x), fmax(chi.y, c.y), fmax(chi.z, c.z));
    }
    double m = s->tmin; /* boxes a little wider than their contents: flat ones would lose hits to rounding */
    Node node = {sub(lo, v(m, m, m)), add(hi, v(m, m, m)), -1, -1, first, count};
    V size = sub(chi, clo);
    int k = size.x >= size.y && size.x >= size.z ? 0 : size.y >= size.z ? 1 : 2;
    double middle = 0.5 * (axis_of(clo, k) + axis_of(chi, k));
    if (count > 4 && axis_of(size, k) > 0) {
        int j = first;
        for (int i = first; i < first + count; i++) {
            bounds(s, s->order[i], &a, &b);
            if (0.5 * (axis_of(a, k) + axis_of(b, k)) < middle) {
                int swap = s->order[i]; s->order[i] = s->order[j]; s->order[j++] = swap;
            }
        }
        if (j > first && j < first + count) {
            node.left = build(s, first, j - first);
            node.right = build(s, j, first + count - j);
        }
    }
    s->nodes[id] = node;
    return id;
}

/* Roots of a quadric's ray equation a t^2 + 2 b t + c; on_it: the origin lies on it, so c is exactly 0. */
static int roots(double a, double b, double c, int on_it, double t[2]) {
    if (on_it) { t[0] = fmin(0, -2 * b / a); t[1] = fmax(0, -2 * b / a); return 1; }
    double d = b * b - a * c;
    if (!(d >= 0) || a == 0) return 0;
    double q = -(b + copysign(sqrt(d), b));
    double r0 = q / a, r1 = q != 0 ? c / q : r0;
    t[0] = fmin(r0, r1); t[1] = fmax(r0, r1);
    return 1;
}

static void hit_prim(const Scene *s, int i, V o, V d, int from, Hit *h) {
    const double *q = s->prims + (size_t)PRIM * i;
    int type = s->kind[4 * i];
    double t[2];
    if (type == TRIANGLE) {
        if (i == from) return;
        V e1 = at(q + 3), e2 = at(q + 6), pv = cross(d, e2);
        double det = dot(e1, pv);
        if (det == 0) return;
        V tv = sub(o, at(q));
        double u = dot(tv, pv) / det;
        if (u < 0 || u > 1) return;
        V qv = cross(tv, e1);
        double w = dot(d, qv) / det;
        if (w < 0 || u + w > 1) return;
        t[0] = t[1] = dot(e2, qv) / det;
    } else if (type == SPHERE) {
        V oc = sub(o, at(q));
        if (!roots(dot(d, d), dot(oc, d), (len(oc) - q[3]) * (len(oc) + q[3]), i == from, t)) return;
    } else {
        V ax = at(q + 3), oc = sub(o, at(q));
        V dp = sub(d, mul(ax, dot(d, ax))), op = sub(oc, mul(ax, dot(oc, ax)));
        if (!roots(dot(dp, dp), dot(op, dp), (len(op) - q[6]) * (len(op) + q[6]), i == from, t)) return;
    }
    for (int k = 0; k < 2; k++) {
        if (!(t[k] > s->tmin)) continue;
        if (type == CYLINDER) {
            double z = dot(sub(add(o, mul(d, t[k])), at(q)), at(q + 3));
            if (z < 0 || z > q[7]) continue;
        }
        if (t[k] < h->t - s->tmin || (t[k] < h->t + s->tmin && (h->prim < 0 || i < h->prim))) { h->t = t[k]; h->prim = i; }
        return;
    }
}

static int box_hit(const Node *n, V o, V inv, double t) {
    double a = (n->lo.x - o.x) * inv.x, b = (n->hi.x - o.x) * inv.x, lo = fmin(a, b), hi = fmax(a, b);
    a = (n->lo.y - o.y) * inv.y; b = (n->hi.y - o.y) * inv.y; lo = fmax(lo, fmin(a, b)); hi = fmin(hi, fmax(a, b));
    a = (n->lo.z - o.z) * inv.z; b = (n->hi.z - o.z) * inv.z; lo = fmax(lo, fmin(a, b)); hi = fmin(hi, fmax(a, b));
    return hi >= lo && hi >= 0 && lo <= t;
}

/* Nearest primitive along a unit direction, before distance t. */
static int nearest(const Scene *s, V o, V d, int from, double t, Hit *h) {
    int stack[128], top = 0;
    V inv = v(1 / (d.x == 0 ? 1e-300 : d.x), 1 / (d.y == 0 ? 1e-300 : d.y), 1 / (d.z == 0 ? 1e-300 : d.z));
    h->prim = -1; h->t = t;
    stack[top++] = 0;
    while (top) {
        const Node *n = s->nodes + stack[--top];
        if (!box_hit(n, o, inv, h->t + s->tmin)) continue;
        if (n->left < 0) { for (int i = 0; i < n->count; i++) hit_prim(s, s->order[n->first + i], o, d, from, h); }
        else { stack[top++] = n->left; stack[top++] = n->right; }
    }
    return h->prim >= 0;
}

/* Fill in position, normals and texture coordinates at a point on a primitive. */
static void surface(const Scene *s, int i, V p, Hit *h) {
    const double *q = s->prims + (size_t)PRIM * i;
    h->prim = i; h->p = p; h->mat = s->kind[4 * i + 1]; h->u = h->v = 0;
    V n;
    if (s->kind[4 * i] == TRIANGLE) {
        h->ng = n = s->normal[i];
        V e1 = at(q + 3), e2 = at(q + 6), c = cross(e1, e2), r = sub(p, at(q));
        double area2 = dot(c, c), b = dot(cross(r, e2), c) / area2, w = dot(cross(e1, r), c) / area2, a = 1 - b - w;
        h->u = a * q[18] + b * q[20] + w * q[22]; h->v = a * q[19] + b * q[21] + w * q[23];
        if (s->kind[4 * i + 3]) n = unit(add(add(mul(at(q + 9), a), mul(at(q + 12), b)), mul(at(q + 15), w)));
    } else if (s->kind[4 * i] == SPHERE) {
        h->ng = n = mul(unit(sub(p, at(q))), q[4]);
    } else {
        V ax = at(q + 3), r = sub(p, at(q));
        h->ng = n = mul(unit(sub(r, mul(ax, dot(r, ax)))), q[8]);
    }
    h->sh = frame(n);
}

/* ---- Materials ---------------------------------------------------------------------------------------------- */
static double value(const Scene *s, int m, double u, double w) {
    int t = s->mkind[4 * m + 3];
    if (t < 0) return s->mats[MAT * m];
    const int *k = s->tkind + 4 * t;
    const double *x = s->texels + k[0];
    double fx = u * k[1] - 0.5, fy = (1 - w) * k[2] - 0.5;
    if (k[3]) { fx = floor(fx + 0.5); fy = floor(fy + 0.5); }
    double ix = floor(fx), iy = floor(fy), sum = 0;
    for (int j = 0; j < 2; j++) for (int i = 0; i < 2; i++) {
        long cx = ((long)ix + i) % k[1], cy = ((long)iy + j) % k[2];
        if (cx < 0) cx += k[1];
        if (cy < 0) cy += k[2];
        sum += (i ? fx - ix : 1 - fx + ix) * (j ? fy - iy : 1 - fy + iy) * x[cy * k[1] + cx];
    }
    return sum;
}
/* Unpolarised reflectance of a dielectric interface, eta = index inside / outside, c on the side of the normal > 0;
 * *ct: cosine of the refracted ray, 0 under total reflection; *rel: index on the far side / near side. */
static double fresnel(double c, double eta, double *ct, double *rel) {
    double r = c > 0 ? eta : 1 / eta, s2 = (1 - c * c) / (r * r), ci = fabs(c);
    *rel = r;
    if (s2 >= 1) { *ct = 0; return 1; }
    double t = *ct = sqrt(1 - s2), rs = (ci - r * t) / (ci + r * t), rp = (r * ci - t) / (r * ci + t);
    return 0.5 * (rs * rs + rp * rp);
}
static double metal(double c, double eta, double k) {
    if (eta == 0) return 1;
    double c2 = c * c, s2 = 1 - c2, d = eta * eta - k * k - s2, ab = sqrt(d * d + 4 * eta * eta * k * k);
    double a = sqrt(0.5 * (ab + d)), rs = (ab + c2 - 2 * a * c) / (ab + c2 + 2 * a * c);
    double rp = rs * (c2 * ab + s2 * s2 - 2 * a * c * s2) / (c2 * ab + s2 * s2 + 2 * a * c * s2);
    return 0.5 * (rs + rp);
}
static double lobe(V h, double al, int beckmann) {
    double c2 = h.z * h.z, t2 = (1 - c2) / c2 / (al * al);
    return beckmann ? exp(-t2) / (PI * al * al * c2 * c2) : 1 / (PI * al * al * c2 * c2 * (1 + t2) * (1 + t2));
}
static double smith(V w, double al, int beckmann) {
    double t = sqrt(fmax(0, 1 - w.z * w.z)) / fabs(w.z);
    if (t == 0) return 1;
    if (!beckmann) return 2 / (1 + sqrt(1 + al * al * t * t));
    double a = 1 / (al * t);
    return 2 / (1 + erf(a) + exp(-a * a) / (a * sqrt(PI)));
}
static V flip(V w) { return v(w.x, w.y, -w.z); }
static V neg(V w) { return v(-w.x, -w.y, -w.z); }

/* BSDF without its delta lobes, times the cosine of wo. Both directions point away from the surface. */
static double eval(const Scene *s, int m, double u, double w, V wi, V wo) {
    const double *q = s->mats + MAT * m;
    const int *k = s->mkind + 4 * m;
    double x, f, ct, rel;
    switch (k[0]) {
    case DIFFUSE: return wi.z > 0 && wo.z > 0 ? value(s, m, u, w) / PI * wo.z : 0;
    case ROUGH: {
        if (wi.z <= 0 || wo.z <= 0) return 0;
        V h = unit(add(wi, wo));
        return q[0] * metal(dot(wi, h), q[1], q[2]) * lobe(h, q[3], (int)q[4]) * smith(wi, q[3], (int)q[4]) *
               smith(wo, q[3], (int)q[4]) / (4 * wi.z);
    }
    case PLASTIC:
        if (wi.z <= 0 || wo.z <= 0) return 0;
        x = value(s, m, u, w); rel = 1 / q[1];
        f = -1.4399 * rel * rel + 0.7099 * rel + 0.6681 + 0.0636 / rel; /* Egan and Hilgeman 1973 */
        double fi = fresnel(wi.z, q[1], &ct, &rel), fo = fresnel(wo.z, q[1], &ct, &rel);
        return x / (1 - (q[6] != 0 ? x * f : f)) / (q[1] * q[1]) * (1 - fi) * (1 - fo) / PI * wo.z;
    case BLEND:
        x = value(s, m, u, w);
        return (x < 1 ? (1 - x) * eval(s, k[1], u, w, wi, wo) : 0) + (x > 0 ? x * eval(s, k[2], u, w, wi, wo) : 0);
    case MASK: return value(s, m, u, w) * eval(s, k[1], u, w, wi, wo);
    case TWOSIDED:
        return wi.z > 0 ? eval(s, k[1], u, w, wi, wo) : eval(s, k[2], u, w, flip(wi), flip(wo));
    default: return 0;
    }
}
static int is_delta(int t) { return t == CONDUCTOR || t == DIELECTRIC || t == THIN || t == PLASTIC || t == MASK || t == NULLBSDF; }
static int has_delta(const Scene *s, int m) {
    const int *k = s->mkind + 4 * m;
    if (is_delta(k[0])) return 1;
    return (k[0] == BLEND || k[0] == TWOSIDED) && (has_delta(s, k[1]) || has_delta(s, k[2]));
}
static int is_smooth_only(const Scene *s, int m) {
    const int *k = s->mkind + 4 * m;
    if (k[0] == CONDUCTOR || k[0] == DIELECTRIC || k[0] == THIN || k[0] == NULLBSDF) return 1;
    if (k[0] == BLEND || k[0] == TWOSIDED) return is_smooth_only(s, k[1]) && is_smooth_only(s, k[2]);
    return k[0] == MASK && is_smooth_only(s, k[1]);
}
enum { REFLECT, REFRACT, STRAIGHT };
static double thin_r(double c, double eta) {
    double ct, rel, r = fresnel(fabs(c), eta, &ct, &rel);
    return r >= 1 ? 1 : 2 * r / (1 + r);
}
/* Factor of a delta event on the radiance that travels from the far direction to wi. */
static double delta(const Scene *s, int m, double u, double w, V wi, int event) {
    const double *q = s->mats + MAT * m;
    const int *k = s->mkind + 4 * m;
    double f, ct, rel, x;
    switch (k[0]) {
    case CONDUCTOR: return event == REFLECT && wi.z > 0 ? q[0] * metal(wi.z, q[1], q[2]) : 0;
    case DIELECTRIC:
        f = fresnel(wi.z, q[1], &ct, &rel);
        return event == REFLECT ? f : event == REFRACT ? (1 - f) / (rel * rel) : 0;
    case THIN: f = thin_r(wi.z, q[1]); return event == REFLECT ? f : event == STRAIGHT ? 1 - f : 0;
    case PLASTIC: return event == REFLECT && wi.z > 0 ? q[5] * fresnel(wi.z, q[1], &ct, &rel) : 0;
    case NULLBSDF: return event == STRAIGHT;
    case BLEND: x = value(s, m, u, w);
        return (1 - x) * delta(s, k[1], u, w, wi, event) + x * delta(s, k[2], u, w, wi, event);
    case MASK: x = value(s, m, u, w);
        return x * delta(s, k[1], u, w, wi, event) + (event == STRAIGHT ? 1 - x : 0);
    case TWOSIDED: return wi.z > 0 ? delta(s, k[1], u, w, wi, event) : delta(s, k[2], u, w, flip(wi), event);
    default: return 0;
    }
}
static double index_of(const Scene *s, int m) { /* of the dielectric inside a material; 1 where there is none */
    const int *k = s->mkind + 4 * m;
    if (k[0] == DIELECTRIC) return s->mats[MAT * m + 1];
    if (k[0] == BLEND) { double a = index_of(s, k[1]); return a != 1 ? a : index_of(s, k[2]); }
    return k[0] == MASK ? index_of(s, k[1]) : 1;
}
/* Sample a direction; returns the weight f cos / pdf, 0 to stop; *rel: what the refractive index is multiplied by. */
static double sample(const Scene *s, int m, double u, double w, V wi, Rng *r, V *wo, double *rel) {
    const double *q = s->mats + MAT * m;
    const int *k = s->mkind + 4 * m;
    double f, ct, x, dummy;
    *rel = 1;
    switch (k[0]) {
    case DIFFUSE: {
        if (wi.z <= 0) return 0;
        double a = 2 * PI * rnd(r), b = rnd(r);
        *wo = v(sqrt(b) * cos(a), sqrt(b) * sin(a), sqrt(1 - b));
        return value(s, m, u, w);
    }
    case CONDUCTOR: *wo = v(-wi.x, -wi.y, wi.z); return delta(s, m, u, w, wi, REFLECT);
    case ROUGH: { /* half vector from D cos */
        if (wi.z <= 0) return 0;
        double al = q[3], b = rnd(r), a = 2 * PI * rnd(r);
        double t2 = q[4] != 0 ? -al * al * log1p(-b) : al * al * b / (1 - b), c = 1 / sqrt(1 + t2), sn = sqrt(fmax(0, 1 - c * c));
        V h = v(sn * cos(a), sn * sin(a), c);
        *wo = sub(mul(h, 2 * dot(wi, h)), wi);
        if (wo->z <= 0 || dot(wi, h) <= 0) return 0;
        return q[0] * metal(dot(wi, h), q[1], q[2]) * smith(wi, al, (int)q[4]) * smith(*wo, al, (int)q[4]) * dot(wi, h) / (wi.z * c);
    }
    case DIELECTRIC:
        f = fresnel(wi.z, q[1], &ct, rel);
        if (rnd(r) < f) { *rel = 1; *wo = v(-wi.x, -wi.y, wi.z); return 1; }
        *wo = v(-wi.x / *rel, -wi.y / *rel, wi.z > 0 ? -ct : ct);
        return 1 / (*rel * *rel);
    case THIN:
        *wo = rnd(r) < thin_r(wi.z, q[1]) ? v(-wi.x, -wi.y, wi.z) : neg(wi);
        return 1;
    case NULLBSDF: *wo = neg(wi); return 1;
    case PLASTIC: {
        if (wi.z <= 0) return 0;
        f = fresnel(wi.z, q[1], &ct, &dummy);
        if (rnd(r) < 0.5) { *wo = v(-wi.x, -wi.y, wi.z); return 2 * q[5] * f; }
        double a = 2 * PI * rnd(r), b = rnd(r);
        *wo = v(sqrt(b) * cos(a), sqrt(b) * sin(a), sqrt(1 - b));
        return wo->z > 0 ? 2 * eval(s, m, u, w, wi, *wo) * PI / wo->z : 0;
    }
    case BLEND: x = value(s, m, u, w); return sample(s, rnd(r) < x ? k[2] : k[1], u, w, wi, r, wo, rel);
    case MASK:
        if (rnd(r) < value(s, m, u, w)) return sample(s, k[1], u, w, wi, r, wo, rel);
        *wo = neg(wi); return 1;
    case TWOSIDED:
        if (wi.z > 0) return sample(s, k[1], u, w, wi, r, wo, rel);
        f = sample(s, k[2], u, w, flip(wi), r, wo, rel);
        *wo = flip(*wo); return f;
    }
    return 0;
}

/* ---- Chains of specular events to the laser point ----------------------------------------------------------- */
typedef struct { int prim, event; } Step;
static V plane_reflect(V n, V d) { return sub(d, mul(n, 2 * dot(d, n))); }
/* Follow a chain over the whole planes and spheres, whatever their extent; 0 where it cannot go on. */
static int shoot(const Scene *s, V o, V d, const Step *c, int n, int from, V goal, V gn, V *end) {
    for (int i = 0; i < n; i++) {
        const double *q = s->prims + (size_t)PRIM * c[i].prim;
        V nn; double t;
        if (s->kind[4 * c[i].prim] == TRIANGLE) {
            nn = s->normal[c[i].prim];
            t = dot(sub(at(q), o), nn) / dot(d, nn);
            if (!(t > 0)) return 0;
            o = add(o, mul(d, t));
        } else {
            double tt[2]; V oc = sub(o, at(q));
            if (!roots(1, dot(oc, d), (len(oc) - q[3]) * (len(oc) + q[3]), from == c[i].prim, tt) || tt[1] <= s->tmin) return 0;
            o = add(o, mul(d, tt[0] > s->tmin ? tt[0] : tt[1]));
            nn = mul(unit(sub(o, at(q))), q[4]);
        }
        if (c[i].event == REFLECT) d = plane_reflect(nn, d);
        else if (c[i].event == REFRACT) {
            double ct, rel, ci = -dot(d, nn);
            if (fresnel(ci, index_of(s, s->kind[4 * c[i].prim + 1]), &ct, &rel) >= 1) return 0;
            V tangential = mul(add(d, mul(nn, ci)), 1 / rel);
            d = add(tangential, mul(nn, ci > 0 ? -ct : ct));
        }
        from = c[i].prim;
    }
    double t = dot(sub(goal, o), gn) / dot(d, gn);
    if (!(t > 0)) return 0;
    *end = add(o, mul(d, t));
    return 1;
}
typedef struct {
    V p, n; Frame f; int prim, mat; V to_device; double u, v, energy, spot;
} Laser;
/* Newton's method with halved steps for the direction from o in which a chain ends at goal. */
static int newton(const Scene *s, V o, const Step *c, int n, int from, V goal, V gn, V d, V *dir, double *jacobian) {
    Frame g = frame(gn);
    for (int i = 0; i < 60; i++) {
        V e0, ea, eb; Frame f = frame(d);
        const double h = 1e-6;
        if (!shoot(s, o, d, c, n, from, goal, gn, &e0)) return 0;
        if (!shoot(s, o, unit(add(d, mul(f.s, h))), c, n, from, goal, gn, &ea)) return 0;
        if (!shoot(s, o, unit(add(d, mul(f.t, h))), c, n, from, goal, gn, &eb)) return 0;
        V r = sub(e0, goal), ja = mul(sub(ea, e0), 1 / h), jb = mul(sub(eb, e0), 1 / h);
        double rx = dot(r, g.s), ry = dot(r, g.t), m00 = dot(ja, g.s), m10 = dot(ja, g.t), m01 = dot(jb, g.s), m11 = dot(jb, g.t);
        double det = m00 * m11 - m01 * m10, residual = len(r), step = 1;
        if (det == 0) return 0;
        *dir = d; *jacobian = 1 / fabs(det);
        if (residual < 1e-10) return 1;
        V way = add(mul(f.s, -(m11 * rx - m01 * ry) / det), mul(f.t, -(m00 * ry - m10 * rx) / det));
        int k = 0;
        for (; k < 30; k++, step *= 0.5) {
            V next = unit(add(d, mul(way, step)));
            if (shoot(s, o, next, c, n, from, goal, gn, &e0) && len(sub(e0, goal)) < residual) { d = next; break; }
        }
        if (k == 30) return 0;
    }
    return 0;
}
/* Direction from o in which the chain ends at the laser point, and d(solid angle at o) / d(area at the laser). */
static int aim(const Scene *s, V o, const Step *c, int n, int from, V goal, V gn, V *dir, double *jacobian) {
    int straight = 1;
    V image = goal, g = gn;
    for (int i = n - 1; i >= 0; i--) {
        if (s->kind[4 * c[i].prim] != TRIANGLE || c[i].event == REFRACT) straight = 0;
        if (s->kind[4 * c[i].prim] == TRIANGLE && c[i].event == REFLECT) {
            V nn = s->normal[c[i].prim];
            image = sub(image, mul(nn, 2 * dot(sub(image, at(s->prims + (size_t)PRIM * c[i].prim)), nn)));
            g = plane_reflect(nn, g);
        }
    }
    V way = sub(image, o);
    double d2 = dot(way, way);
    if (d2 == 0 && straight) return 0;
    *dir = unit(way);
    if (straight) { *jacobian = fabs(dot(g, *dir)) / d2; return 1; }
    if (s->kind[4 * c[0].prim] == SPHERE) { /* start where the normal halves the angle at the centre */
        const double *q = s->prims + (size_t)PRIM * c[0].prim;
        V a = add(unit(sub(o, at(q))), unit(sub(goal, at(q))));
        *dir = unit(sub(add(at(q), mul(unit(a), q[3])), o));
    }
    V first = mul(s->normal[c[0].prim], copysign(1, dot(s->normal[c[0].prim], *dir))), begin = *dir;
    /* straight on may be totally reflected: start ever nearer to the first plane's normal */
    for (int k = 0; k < 5; k++)
        if (newton(s, o, c, n, from, goal, gn, unit(add(mul(begin, 1 - 0.25 * k), mul(first, 0.25 * k))), dir, jacobian)) return 1;
    return 0;
}

/* ---- Deposits ----------------------------------------------------------------------------------------------- */
typedef struct { double start, width; int n_bins, max_bounce, n_slots; double *h, *outside; } Window;
static void deposit(Window *w, int bounce, double opl, double x) {
    if (!(x != 0) || bounce > w->max_bounce) return;
    int slot = bounce - 2 < w->n_slots ? bounce - 2 : w->n_slots - 1;
    double b = floor((opl - w->start) / w->width);
    if (b >= 0 && b < w->n_bins) w->h[(size_t)slot * w->n_bins + (size_t)b] += x;
    else w->outside[slot] += x;
}
static double lit(const Scene *s, const Laser *l, V towards) { /* wall's BSDF times cosine */
    return l->energy * eval(s, l->mat, l->u, l->v, local(&l->f, l->to_device), local(&l->f, towards));
}
static int clear_to(const Scene *s, V o, int from, V goal, int goal_prim) {
    V d = sub(goal, o); double t = len(d); Hit h;
    if (t == 0) return 0;
    d = mul(d, 1 / t);
    if (!nearest(s, o, d, from, t - 2 * s->tmin, &h)) return 1;
    /* the laser point's own primitive is flat, or met at a real distance before it */
    return h.prim == goal_prim && s->kind[4 * goal_prim] == TRIANGLE;
}
/* Connect a vertex to the laser point directly and over every chain of specular events. */
static void connect(const Scene *s, const Laser *base, const Hit *x, V wi, double beta, int bounce, double opl, double index, Rng *r, Window *win) {
    if (is_smooth_only(s, x->mat)) return;
    Laser moved = *base; const Laser *l = base;
    if (base->spot > 0) {
        double a = 2 * PI * rnd(r), b = base->spot * sqrt(rnd(r));
        moved.p = add(base->p, add(mul(base->f.s, b * cos(a)), mul(base->f.t, b * sin(a))));
        l = &moved;
    }
    V d = sub(l->p, x->p); double t = len(d);
    if (t > 0) {
        d = mul(d, 1 / t);
        double f = beta * eval(s, x->mat, x->u, x->v, wi, local(&x->sh, d));
        if (f != 0) f *= lit(s, l, neg(d)) / (t * t);
        if (f != 0 && clear_to(s, x->p, x->prim, l->p, l->prim)) deposit(win, bounce, opl + index * t, f);
    }
    for (int k = 0; k < s->n_chains; k++) {
        const int *row = s->chains[k]; int n = row[0];
        if (bounce + n > win->max_bounce) continue;
        Step c[MAX_CHAIN]; double jac;
        for (int i = 0; i < n; i++) { c[i].prim = row[1 + 2 * i]; c[i].event = row[2 + 2 * i]; }
        if (c[0].prim == x->prim && s->kind[4 * x->prim] == TRIANGLE) continue;
        if (!aim(s, x->p, c, n, x->prim, l->p, l->n, &d, &jac)) continue;
        double f = beta * eval(s, x->mat, x->u, x->v, wi, local(&x->sh, d)) * jac;
        V o = x->p; int from = x->prim; double length = opl, medium = index;
        for (int i = 0; i < n && f != 0; i++) {
            Hit h;
            if (!nearest(s, o, d, from, 1e300, &h) || h.prim != c[i].prim) { f = 0; break; }
            surface(s, h.prim, add(o, mul(d, h.t)), &h);
            length += medium * h.t; /* h.t survives surface() */
            V in = local(&h.sh, neg(d));
            f *= delta(s, h.mat, h.u, h.v, in, c[i].event);
            if (c[i].event == REFLECT) d = world(&h.sh, v(-in.x, -in.y, in.z));
            else if (c[i].event == REFRACT) {
                double ct, rel; fresnel(in.z, index_of(s, h.mat), &ct, &rel); medium *= rel;
                d = world(&h.sh, v(-in.x / rel, -in.y / rel, in.z > 0 ? -ct : ct));
            }
            o = h.p; from = h.prim;
        }
        if (f == 0) continue;
        V last = sub(l->p, o); double tl = len(last);
        double cosine = fabs(dot(l->n, d)); /* the Jacobian holds it already, as lit() does */
        if (cosine == 0) continue;
        f *= lit(s, l, neg(d)) / cosine;
        if (f != 0 && clear_to(s, o, from, l->p, l->prim)) deposit(win, bounce + n, length + medium * tl, f);
    }
}

static double area_of(const Scene *s, int i) {
    const double *q = s->prims + (size_t)PRIM * i;
    if (s->kind[4 * i] == TRIANGLE) return 0.5 * len(cross(at(q + 3), at(q + 6)));
    return s->kind[4 * i] == SPHERE ? 4 * PI * q[3] * q[3] : 2 * PI * q[6] * q[7];
}
static V point_on(const Scene *s, int i, double a, double b) {
    const double *q = s->prims + (size_t)PRIM * i;
    if (s->kind[4 * i] == TRIANGLE) {
        double r = sqrt(a);
        return add(at(q), add(mul(at(q + 3), r * (1 - b)), mul(at(q + 6), r * b)));
    }
    if (s->kind[4 * i] == SPHERE) {
        double z = 1 - 2 * a, r = sqrt(fmax(0, 1 - z * z));
        return add(at(q), mul(v(r * cos(2 * PI * b), r * sin(2 * PI * b), z), q[3]));
    }
    Frame f = frame(at(q + 3));
    return add(add(at(q), mul(f.n, q[7] * a)), add(mul(f.s, q[6] * cos(2 * PI * b)), mul(f.t, q[6] * sin(2 * PI * b))));
}

/* One path from a sensor point; a, b, by_area: numbers of its first direction, of a low-discrepancy sequence. */
static void path(const Scene *s, const Hit *x0, V wi0, const Laser *l, double opl0, double a, double b, int by_area, Rng *r, Window *w) {
    Hit x = *x0, h; V d; int target = -1; double goal = 0, both = s->total > 0 ? 0.5 : 1;
    if (by_area) {
        double y = a * s->total; int lo = 0, hi = s->n_prims - 1;
        while (lo < hi) { int mid = (lo + hi) / 2; if (s->cdf[mid] > y) hi = mid; else lo = mid + 1; }
        double below = lo ? s->cdf[lo - 1] : 0;
        target = lo;
        d = sub(point_on(s, target, (y - below) / (s->cdf[lo] - below), b), x.p);
        goal = len(d);
        if (goal == 0) return;
        d = mul(d, 1 / goal);
    } else {
        double rr = sqrt(a);
        d = world(&x.sh, v(rr * cos(2 * PI * b), rr * sin(2 * PI * b), sqrt(1 - a)));
    }
    V wo = local(&x.sh, d);
    double f = eval(s, x.mat, x.u, x.v, wi0, wo);
    if (f == 0 || !nearest(s, x.p, d, x.prim, 1e300, &h)) return;
    if (by_area && (h.prim != target || fabs(h.t - goal) > 1e-7 * goal)) return;
    double beta = f, opl = opl0, index = 1, survive = 1; int first = 1;
    for (int bounce = 3; bounce <= w->max_bounce; bounce++) {
        double t = h.t;
        surface(s, h.prim, add(x.p, mul(d, t)), &h);
        if (first) {
            double pb = wo.z / PI, pa = 0;
            if (s->kind[4 * h.prim + 2] && s->total > 0) pa = t * t / fmax(1e-12, fabs(dot(h.ng, d))) / s->total;
            beta = f / (both * pb + 0.5 * pa);
            first = 0;
        }
        opl += index * t;
        if (opl > w->start + w->width * w->n_bins && opl - opl0 > 0) { /* later light is outside whatever it does */ return; }
        V wi = local(&h.sh, neg(d));
        connect(s, l, &h, wi, beta, bounce, opl, index, r, w);
        if (bounce == w->max_bounce) return;
        double rel, weight = sample(s, h.mat, h.u, h.v, wi, r, &wo, &rel);
        if (!(weight > 0)) return;
        survive = bounce >= 4 ? fmin(weight, 0.95) : 1;
        if (survive < 1 && rnd(r) >= survive) return;
        beta *= weight / survive; index *= rel;
        d = world(&h.sh, wo);
        x = h;
        if (!nearest(s, x.p, d, x.prim, 1e300, &h)) return;
    }
}

/* ---- Interface ---------------------------------------------------------------------------------------------- */
static void add_chain(Scene *s, const Step *c, int n) {
    if (s->n_chains == s->cap_chains) {
        s->cap_chains = s->cap_chains ? 2 * s->cap_chains : 64;
        s->chains = realloc(s->chains, (size_t)s->cap_chains * sizeof *s->chains);
    }
    int *row = s->chains[s->n_chains++];
    row[0] = n;
    for (int i = 0; i < n; i++) { row[1 + 2 * i] = c[i].prim; row[2 + 2 * i] = c[i].event; }
}
static int can_do(const Scene *s, int m, int event) {
    const int *k = s->mkind + 4 * m;
    if (k[0] == BLEND || k[0] == TWOSIDED) return can_do(s, k[1], event) || can_do(s, k[2], event);
    if (k[0] == MASK) return event == STRAIGHT || can_do(s, k[1], event);
    if (event == REFLECT) return k[0] == CONDUCTOR || k[0] == PLASTIC || k[0] == DIELECTRIC || k[0] == THIN;
    return event == REFRACT ? k[0] == DIELECTRIC : k[0] == THIN || k[0] == NULLBSDF;
}
static void list_chains(Scene *s, Step *c, int n, int most) {
    if (n) add_chain(s, c, n);
    if (n == most) return;
    for (int i = 0; i < s->n_prims; i++) {
        if (n && c[n - 1].prim == i && s->kind[4 * i] == TRIANGLE) continue;
        if (!has_delta(s, s->kind[4 * i + 1])) continue;
        for (int e = REFLECT; e <= STRAIGHT; e++)
            if (can_do(s, s->kind[4 * i + 1], e)) { c[n].prim = i; c[n].event = e; list_chains(s, c, n + 1, most); }
    }
}

typedef struct {
    Scene *s; int n_rows, replicas; int64_t samples; uint64_t seed; const double *rows; Window window;
    double *mean, *variance, *outside; int next; pthread_mutex_t lock;
} Job;
/* Row: 0 sensor point, 3 its primitive, 4 direction to the sensor, 7 laser point, 10 its primitive, 11 direction to
 * the laser, 14 legs, 15 energy, 16 spot radius. */
static void render_row(Job *j, int row) {
    const double *q = j->rows + 17 * (size_t)row; Scene *s = j->s;
    Hit x, y; surface(s, (int)q[3], at(q), &x); surface(s, (int)q[10], at(q + 7), &y);
    Laser l = {y.p, y.sh.n, y.sh, y.prim, y.mat, at(q + 11), y.u, y.v, q[15], q[16]};
    Window w = j->window;
    size_t n = (size_t)w.n_slots * w.n_bins, base = n * row;
    w.h = malloc(n * sizeof(double)); w.outside = malloc(w.n_slots * sizeof(double));
    V wi = local(&x.sh, at(q + 4));
    double *m = j->mean + base, *var = j->variance + base;
    for (int k = 0; k < j->replicas; k++) {
        Rng r = {j->seed * 0xD1342543DE82EF95ull + (uint64_t)row * 0x2545F4914F6CDD1Dull + (uint64_t)k * 0x9E6C63D0876A9A47ull};
        next64(&r); next64(&r);
        memset(w.h, 0, n * sizeof(double)); memset(w.outside, 0, w.n_slots * sizeof(double));
        double a = rnd(&r), b = rnd(&r);
        for (int64_t i = 0; i < j->samples; i++) { /* R2 sequence of Roberts, shifted at random */
            a += 0.7548776662466927; b += 0.5698402909980532; a -= a >= 1; b -= b >= 1;
            path(s, &x, wi, &l, q[14], a, b, s->total > 0 && (i & 1), &r, &w);
        }
        for (size_t i = 0; i < n; i++) w.h[i] /= j->samples;
        for (int i = 0; i < w.n_slots; i++) w.outside[i] /= j->samples;
        int tries = l.spot > 0 ? 512 : 1; /* straight from sensor point to laser point, and over mirrors */
        for (int i = 0; i < tries; i++) connect(s, &l, &x, wi, 1.0 / tries, 2, q[14], 1, &r, &w);
        for (size_t i = 0; i < n; i++) { double e = w.h[i] - m[i]; m[i] += e / (k + 1); var[i] += e * (w.h[i] - m[i]); }
        for (int i = 0; i < w.n_slots; i++) j->outside[(size_t)row * w.n_slots + i] += w.outside[i] / j->replicas;
    }
    for (size_t i = 0; i < n; i++) var[i] /= (double)j->replicas * (j->replicas - 1);
    free(w.h); free(w.outside);
}
static void *work(void *arg) {
    Job *j = arg;
    for (;;) {
        pthread_mutex_lock(&j->lock);
        int row = j->next++;
        pthread_mutex_unlock(&j->lock);
        if (row >= j->n_rows) return NULL;
        render_row(j, row);
    }
}

/* mean, variance: (rows, slots, bins), outside: (rows, slots), all zero on entry. Variance is of the mean, over
 * replicas of samples paths each. */
int reference_render(int n_prims, const int *kind, const double *prims, int n_mats, const int *mkind, const double *mats,
                     const int *tkind, const double *texels, int n_rows, const double *rows, double start, double width,
                     int n_bins, int max_bounce, int n_slots, int chain, int replicas, int64_t samples, uint64_t seed,
                     int threads, double *mean, double *variance, double *outside) {
    Scene s = {.n_prims = n_prims, .n_mats = n_mats, .prims = prims, .mats = mats, .kind = kind, .mkind = mkind, .tkind = tkind, .texels = texels};
    s.order = malloc(n_prims * sizeof(int)); s.nodes = malloc((2 * n_prims + 1) * sizeof(Node));
    s.cdf = malloc(n_prims * sizeof(double)); s.normal = malloc(n_prims * sizeof(V));
    double extent = 1e-300; V a, b;
    for (int i = 0; i < n_prims; i++) {
        const double *q = prims + (size_t)PRIM * i;
        s.order[i] = i;
        s.cdf[i] = s.total += kind[4 * i + 2] ? area_of(&s, i) : 0;
        s.normal[i] = kind[4 * i] == TRIANGLE ? unit(cross(at(q + 3), at(q + 6))) : v(0, 0, 1);
        bounds(&s, i, &a, &b);
        extent = fmax(extent, fmax(fmax(fmax(fabs(a.x), fabs(a.y)), fabs(a.z)), fmax(fmax(fabs(b.x), fabs(b.y)), fabs(b.z))));
    }
    s.tmin = EPS * extent;
    build(&s, 0, n_prims);
    Step c[MAX_CHAIN];
    list_chains(&s, c, 0, chain < MAX_CHAIN ? chain : MAX_CHAIN);
    Job j = {&s, n_rows, replicas, samples, seed, rows, {start, width, n_bins, max_bounce, n_slots, NULL, NULL}, mean, variance, outside, 0, PTHREAD_MUTEX_INITIALIZER};
    pthread_t id[64];
    threads = threads < 1 ? 1 : threads > 64 ? 64 : threads;
    for (int i = 1; i < threads; i++) if (pthread_create(id + i, NULL, work, &j)) return 1;
    work(&j);
    for (int i = 1; i < threads; i++) pthread_join(id[i], NULL);
    free(s.order); free(s.nodes); free(s.cdf); free(s.normal); free(s.chains);
    return 0;
}
